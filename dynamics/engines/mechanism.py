"""Mechanism in a file of another program: bodies at home, their connections, and legs as chains.

Bodies that are welded together become one body. Joints that meet in a body without mass become one
joint: two hinges become a universal joint, three a ball.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dynamics.errors import RobotFileError
from dynamics.legs.chain import SAME, Chain

BASE = 0
"""Number of the body that stands still."""

SHARE_OF_HUB = 1e-4
"""Share of all mass below which a body between two hinges is a part of their joint.

Engines ask for some mass.
"""


@dataclass(frozen=True)
class Solid:
    """Body at home, in the axes of the base.

    Mass, kg; centre of mass (3,), m; inertia about it (3, 3), kg m^2; its own axes (3, 3) as
    columns; and length and radius of a rod that is drawn of it.
    """

    name: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    axes: np.ndarray
    rod: tuple[float, float] | None = None


class Freedom(NamedTuple):
    """Elementary joint between two bodies.

    Its kind is "hinge", "slide" or "ball". It is at a point (3,), m, about or along an axis (3,),
    in the axes of the base. `coordinate` is that at home, `friction` is dry and viscous, and
    `actuator` its number, or None.
    """

    kind: str
    name: str
    point: np.ndarray
    axis: np.ndarray
    coordinate: float = 0.0
    friction: tuple[float, float] = (0.0, 0.0)
    actuator: int | None = None


@dataclass(frozen=True)
class Connection:
    """Connection of two bodies, by their numbers.

    Its elementary joints are in the order from the first body. A weld has none.
    """

    first: int
    second: int
    freedoms: tuple[Freedom, ...]

    def other(self, body: int) -> int:
        """Number of the body at the other end."""
        return self.second if body == self.first else self.first

    def seen_from(self, body: int) -> tuple[Freedom, ...]:
        """Joints in the order from a body.

        Their axes are those about which, or along which, the other body moves.
        """
        if body == self.first:
            return self.freedoms
        return tuple(one._replace(axis=-one.axis) for one in self.freedoms[::-1])


@dataclass(frozen=True)
class Mechanism:
    """Bodies, with the base first, and their connections.

    `gravity` (3,) is in m/s^2, and `travel_limit` in rad or m. `ranges` are those of joints by
    name, where the file has them, `gains` are lp, li, ld (3,), and `notes` are remarks on the file.
    """

    name: str
    solids: list[Solid]
    connections: list[Connection]
    gravity: np.ndarray
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    gains: np.ndarray | None = None
    travel_limit: float | None = None
    notes: tuple[str, ...] = ()


class MechanismLeg(NamedTuple):
    """Leg: its chain of joints, its actuated joint, and its bodies from the base.

    A body is a list of the bars that it consists of.
    """

    chain: Chain
    actuated: Freedom
    bodies: list[list[Solid]]


def simplified(mechanism: Mechanism) -> Mechanism:
    """Mechanism with welded bodies as one, and without bodies that are only part of a joint."""
    solids = list(mechanism.solids)
    connections = list(mechanism.connections)
    while weld := next((one for one in connections if not one.freedoms), None):
        keep, gone = sorted((weld.first, weld.second))
        solids[keep] = solids[keep] if keep == BASE else _together(solids[keep], solids[gone])
        connections = _moved(connections, weld, gone, keep)
    limit = SHARE_OF_HUB * sum(solid.mass for solid in mechanism.solids[1:])
    notes = list(mechanism.notes)
    while (hub := _hub(solids, connections, limit)) is not None:
        body, (a, b) = hub
        if solids[body].mass:
            notes.append(
                f"{solids[body].name} ({solids[body].mass:g} kg) is part of a joint here, without "
                "mass"
            )
        freedoms = a.seen_from(a.other(body)) + b.seen_from(body)
        connections[connections.index(a)] = Connection(a.other(body), b.other(body), freedoms)
        connections.remove(b)
    return replace(mechanism, solids=solids, connections=connections, notes=tuple(notes))


def platform_of(mechanism: Mechanism) -> int:
    """Number of the body at which the legs come together.

    Raises RobotFileError where there is none.
    """
    count = dict.fromkeys(range(1, len(mechanism.solids)), 0)
    for one in mechanism.connections:
        for body in {one.first, one.second} - {BASE}:
            count[body] += 1
    most = max(count.values(), default=0)
    found = [body for body, number in count.items() if number == most]
    if most < 2 or len(found) > 1:
        names = ", ".join(mechanism.solids[body].name for body in found) or "none"
        raise RobotFileError(
            f"no body is the platform, where all legs meet: most joints ({most}) have {names}"
        )
    return found[0]


def legs_of(
    mechanism: Mechanism, platform: int, from_platform: np.ndarray
) -> Iterator[MechanismLeg]:
    """Legs of a simplified mechanism, each a chain from the base to the platform.

    A chain may have two bars. `from_platform` (3, 4) holds platform axes and origin at home. Raises
    RobotFileError, with leg and bodies, for any other mechanism.
    """
    left = [body for body in range(1, len(mechanism.solids)) if body != platform]
    number = 0
    while left:
        members = _reached(mechanism, left[0], {BASE, platform})
        left = [body for body in left if body not in members]
        if not any({one.first, one.second} & members for one in mechanism.connections):
            continue
        number += 1
        try:
            yield _leg(mechanism, members, platform, from_platform)
        except RobotFileError as error:
            names = ", ".join(mechanism.solids[body].name for body in sorted(members))
            raise RobotFileError(f"leg {number} ({names}): {error}") from None


def _leg(
    mechanism: Mechanism, members: set[int], platform: int, from_platform: np.ndarray
) -> MechanismLeg:
    """Leg of its member bodies."""
    joined = sum(bool({one.first, one.second} & members) for one in mechanism.connections)
    # more loops would have ways without number
    if joined > len(members) + 2:
        raise RobotFileError(
            f"{joined} joints hold its {len(members)} bodies, at most {len(members) + 2} make one "
            "way from the base to the platform, or two equal bars"
        )
    paths = list(_paths(mechanism, BASE, platform, members, []))
    solids = mechanism.solids
    if not paths or len(paths) > 2 or len({len(path) for path in paths}) > 1:
        raise RobotFileError(
            f"it has {len(paths)} ways from the base to the platform, must have one, or two equal "
            "bars"
        )
    for body in sorted(members - {body for path in paths for body, _ in path}):
        raise RobotFileError(f"{solids[body].name} is on no way from the base to the platform")
    actuated = [
        one for body, joint in paths[0] for one in joint.seen_from(body) if one.actuator is not None
    ]
    if len(actuated) != 1:
        raise RobotFileError(f"it has {len(actuated)} actuated joints, must have one")
    joints = []
    points = []
    axes = []
    bodies = []
    across = np.zeros(3)
    for steps in zip(*paths, strict=True):
        kinds = [_joint(connection.seen_from(body)) for body, connection in steps]
        kind, point, axis = kinds[0]
        if (
            len({body for body, _ in steps}) > 1
            or len({id(connection) for _, connection in steps}) > 1
        ):
            if kinds[0][0] != kinds[1][0]:
                raise RobotFileError(
                    f"its two bars are joined differently, by {kinds[0][0]} and {kinds[1][0]}"
                )
            before = across
            across = kinds[1][1] - kinds[0][1]
            if before.any() and np.linalg.norm(across - before) > SAME:
                raise RobotFileError("its two bars are not parallel")
            point = (kinds[0][1] + kinds[1][1]) / 2
        joints.append(kind + "*" * sum(one.actuator is not None for one in steps[0][1].freedoms))
        points.append(point)
        axes.append(axis)
        bodies.append([solids[body] for body in dict.fromkeys(body for body, _ in steps)])
    bodies = bodies[1:]
    centres = np.array([np.average([s.centre for s in bars], axis=0) for bars in bodies])
    end = from_platform[:, :3].T @ (points[-1] - from_platform[:, 3])
    rods = [bars[0].rod for bars in bodies]
    chain = Chain(
        tuple(joints),
        np.array(points),
        np.array(axes),
        actuated[0].coordinate,
        end,
        across,
        centres,
        rods,
    )
    return MechanismLeg(chain, actuated[0], bodies)


def _paths(
    mechanism: Mechanism,
    body: int,
    end: int,
    members: set[int],
    behind: list[tuple[int, Connection]],
) -> Iterator[list[tuple[int, Connection]]]:
    """Ways from a body to the end through members, as steps.

    A step is the body that it begins at, and its connection.
    """
    for connection in mechanism.connections:
        if body not in (connection.first, connection.second):
            continue
        other = connection.other(body)
        path = [*behind, (body, connection)]
        if other == end and behind:
            yield path
        elif other in members and other not in [step[0] for step in behind]:
            yield from _paths(mechanism, other, end, members, path)


def _joint(freedoms: tuple[Freedom, ...]) -> tuple[str, np.ndarray, np.ndarray]:
    """Kind of joint that elementary ones make, its place (3,), and its axes (2, 3)."""
    for one in freedoms:
        if one.actuator is None and any(one.friction):
            raise RobotFileError(
                f"{one.name} has friction {max(one.friction):g}; joints without actuator have none "
                "here"
            )
    kinds = [one.kind for one in freedoms]
    axes = np.array([one.axis for one in freedoms] + [np.full(3, np.nan)])[:2]
    if len(kinds) == 1:
        return kinds[0], freedoms[0].point, axes
    if kinds not in (2 * ["hinge"], 3 * ["hinge"]):
        return "-".join(kinds), freedoms[0].point, axes
    directions = np.array([one.axis for one in freedoms])
    square = sum(np.eye(3) - np.outer(axis, axis) for axis in directions)
    pulled = sum((np.eye(3) - np.outer(one.axis, one.axis)) @ one.point for one in freedoms)
    point = np.linalg.lstsq(square, pulled, rcond=None)[0]
    apart = max(float(np.linalg.norm(np.cross(one.axis, point - one.point))) for one in freedoms)
    names = ", ".join(one.name for one in freedoms)
    if apart > SAME:
        raise RobotFileError(f"the hinges {names} pass each other at {2 * apart:.3g} m, must meet")
    if len(kinds) == 2:
        lean = abs(float(directions[0] @ directions[1]))
        if lean > SAME:
            raise RobotFileError(
                f"the hinges {names} are {np.degrees(np.arcsin(lean)):.3g} deg from normal to each "
                "other"
            )
        return "universal", point, axes
    if abs(np.linalg.det(directions)) < 1e-3:
        raise RobotFileError(
            f"the hinges {names} are in one plane at home, and make no ball joint there"
        )
    return "ball", point, axes


def _reached(mechanism: Mechanism, start: int, walls: set[int]) -> set[int]:
    """Bodies that are reached from a start without passing walls."""
    found = {start}
    left = [start]
    while left:
        body = left.pop()
        for one in mechanism.connections:
            if body in (one.first, one.second) and one.other(body) not in found | walls:
                found.add(one.other(body))
                left.append(one.other(body))
    return found


def _hub(
    solids: list[Solid], connections: list[Connection], limit: float
) -> tuple[int, tuple[Connection, Connection]] | None:
    """Body that is only part of a joint, or None.

    It has nearly no mass, and two connections of hinges in one point.
    """
    for body in range(1, len(solids)):
        own = [one for one in connections if body in (one.first, one.second)]
        if (
            len(own) == 2
            and solids[body].mass <= limit
            and all(f.kind == "hinge" for one in own for f in one.freedoms)
        ):
            return body, (own[0], own[1])
    return None


def _moved(connections: list[Connection], gone: Connection, old: int, new: int) -> list[Connection]:
    """Connections without one of them, with those of one body now at another."""
    left = [one for one in connections if one is not gone]
    names = {old: new}
    return [
        Connection(names.get(c.first, c.first), names.get(c.second, c.second), c.freedoms)
        for c in left
    ]


def _together(a: Solid, b: Solid) -> Solid:
    """Two connections as one."""
    mass = a.mass + b.mass
    centre = (a.mass * a.centre + b.mass * b.centre) / mass if mass else a.centre
    inertia = np.zeros((3, 3))
    for one in (a, b):
        shift = one.centre - centre
        inertia += one.inertia + one.mass * (shift @ shift * np.eye(3) - np.outer(shift, shift))
    name = a.name if not b.mass else f"{a.name}+{b.name}"
    return Solid(name, mass, centre, inertia, a.axes, a.rod or b.rod)
