"""Mechanism in a file of another program: its bodies and joints at home, and its legs.

Bodies that are welded together become one body. Hinges that are joined by bodies with almost no
mass become one joint: two hinges become a universal joint, and three become a ball joint.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dynamics.errors import RobotFileError
from dynamics.legs.chain import SAME, Chain

BASE = 0  # number of the body that is fixed to the ground
# Fraction of the total mass up to which a body between hinges counts as part of a joint. Engines
# require that such a body has some mass.
HUB_MASS_RATIO = 1e-4


class Shape(NamedTuple):
    """Mesh that draws a body.

    `scale` is the length of one unit of the file, m. `place` (4, 4) is base_from_mesh at home.
    """

    file: str
    scale: float
    place: np.ndarray


@dataclass(frozen=True)
class Solid:
    """Rigid body at home. All vectors are in the axes of the base.

    `mass` is in kg, and `centre` (3,) is the centre of mass, m. `inertia` (3, 3) is about the
    centre, kg m^2. `axes` (3, 3) has the axes of the body as columns. `rod` is the length and the
    radius of the drawn rod, m, or None. `shapes` are the drawn meshes.
    """

    name: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    axes: np.ndarray
    rod: tuple[float, float] | None = None
    shapes: tuple[Shape, ...] = ()


class Freedom(NamedTuple):
    """Elementary joint between two bodies.

    `kind` is "hinge", "slide" or "ball". `point` (3,), m, and `axis` (3,) are in the axes of the
    base; the axis of a ball is NaN. `coordinate` is its coordinate at home, rad or m. `friction` is
    the dry friction, N m or N, and the viscous friction, N m s/rad or N s/m. `actuator` is the
    number of the actuator, or None.
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
    """Connection of two bodies, which are given by their numbers.

    `freedoms` are its elementary joints in the order from the first body to the second. A weld has
    no elementary joints.
    """

    first: int
    second: int
    freedoms: tuple[Freedom, ...]

    def other(self, body: int) -> int:
        """Number of the body at the other end."""
        return self.second if body == self.first else self.first

    def seen_from(self, body: int) -> tuple[Freedom, ...]:
        """Elementary joints in the order from the given body to the other one.

        The axes are signed for the motion of the other body relative to the given one.
        """
        if body == self.first:
            return self.freedoms
        return tuple(freedom._replace(axis=-freedom.axis) for freedom in self.freedoms[::-1])


@dataclass(frozen=True)
class Mechanism:
    """Bodies, of which the base is the first, and their connections.

    `gravity` (3,) is in m/s^2, and `travel_limit` in rad or m. `ranges` has the ranges of joints
    that the file states, by name, rad or m. `gains` are lp, li, ld (3,), or those of each joint
    (3 n,). `notes` are remarks on the file.
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
    """Leg: its chain of joints, its actuated joint, and its bodies in order from the base.

    Each body is given as a list of the parallel bars that form it.
    """

    chain: Chain
    actuated: Freedom
    bodies: list[list[Solid]]


def simplified(mechanism: Mechanism) -> Mechanism:
    """Merge welded bodies, and replace bodies that are only part of a joint by that joint."""
    solids = list(mechanism.solids)
    connections = list(mechanism.connections)
    while weld := next((c for c in connections if not c.freedoms), None):
        keep, gone = sorted((weld.first, weld.second))
        solids[keep] = solids[keep] if keep == BASE else _together(solids[keep], solids[gone])
        connections = _moved(connections, weld, gone, keep)
    limit = HUB_MASS_RATIO * sum(solid.mass for solid in mechanism.solids[1:])
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
    """Number of the platform, which is the body with the most joints.

    Raises RobotFileError if several bodies have the most joints, or if none has two or more.
    """
    joint_counts = dict.fromkeys(range(1, len(mechanism.solids)), 0)
    for connection in mechanism.connections:
        for body in {connection.first, connection.second} - {BASE}:
            joint_counts[body] += 1
    most = max(joint_counts.values(), default=0)
    candidates = [body for body, number in joint_counts.items() if number == most]
    if most < 2 or len(candidates) > 1:
        names = ", ".join(mechanism.solids[body].name for body in candidates) or "none"
        raise RobotFileError(
            f"no single body can be the platform: the most joints ({most}) belong to {names}"
        )
    return candidates[0]


def legs_of(
    mechanism: Mechanism, platform: int, from_platform: np.ndarray
) -> Iterator[MechanismLeg]:
    """Legs of a simplified mechanism, each as a chain from the base to the platform.

    Two parallel chains of equal bars are given as one chain. The columns of `from_platform` (3, 4)
    are the axes and the origin of the platform at home. Bodies without connections are ignored.
    Raises RobotFileError, with the leg and its bodies, for a mechanism of any other form.
    """
    remaining = [body for body in range(1, len(mechanism.solids)) if body != platform]
    number = 0
    while remaining:
        members = _reached(mechanism, remaining[0], {BASE, platform})
        remaining = [body for body in remaining if body not in members]
        if not any({c.first, c.second} & members for c in mechanism.connections):
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
    """Leg that consists of the member bodies."""
    joined = sum(bool({c.first, c.second} & members) for c in mechanism.connections)
    # with more loops, the number of paths would grow without limit
    if joined > len(members) + 2:
        raise RobotFileError(
            f"it has {joined} joints and {len(members)} bodies; with one path from the base to the "
            f"platform, or two of equal bars, it would have at most {len(members) + 2} joints"
        )
    paths = list(_paths(mechanism, BASE, platform, members, []))
    solids = mechanism.solids
    if not paths or len(paths) > 2 or len({len(path) for path in paths}) > 1:
        raise RobotFileError(
            f"it has {len(paths)} paths from the base to the platform, must have one, or two of "
            "equal bars"
        )
    for body in sorted(members - {body for path in paths for body, _ in path}):
        raise RobotFileError(f"{solids[body].name} is on no path from the base to the platform")
    actuated = [
        freedom
        for body, connection in paths[0]
        for freedom in connection.seen_from(body)
        if freedom.actuator is not None
    ]
    if len(actuated) != 1:
        raise RobotFileError(f"it has {len(actuated)} actuated joints, must have one")
    joints = []
    points = []
    axes = []
    bodies = []
    bar_offset = np.zeros(3)
    for steps in zip(*paths, strict=True):
        kinds = [_joint(connection.seen_from(body)) for body, connection in steps]
        kind, point, axis = kinds[0]
        if (
            len({body for body, _ in steps}) > 1
            or len({id(connection) for _, connection in steps}) > 1
        ):
            if kinds[0][0] != kinds[1][0]:
                raise RobotFileError(
                    f"its two bars have different joints: {kinds[0][0]} and {kinds[1][0]}"
                )
            offset_before = bar_offset
            bar_offset = kinds[1][1] - kinds[0][1]
            if offset_before.any() and np.linalg.norm(bar_offset - offset_before) > SAME:
                raise RobotFileError("its two bars are not parallel")
            # Two equal bars move as one bar in their middle.
            point = (kinds[0][1] + kinds[1][1]) / 2
        joints.append(
            kind + "*" * sum(freedom.actuator is not None for freedom in steps[0][1].freedoms)
        )
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
        bar_offset,
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
    """Paths from a body to the end body that pass only through members, continued from `behind`.

    A path is a list of steps. A step is a body and the connection by which the path leaves it.
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
    """Kind of the joint that elementary joints form, its point (3,), and its axes (2, 3).

    A missing axis is NaN. Raises RobotFileError for friction without an actuator, and for hinges
    that form no universal or ball joint.
    """
    for freedom in freedoms:
        if freedom.actuator is None and any(freedom.friction):
            raise RobotFileError(
                f"{freedom.name} has friction {max(freedom.friction):g}, must have none without an "
                "actuator"
            )
    kinds = [freedom.kind for freedom in freedoms]
    axes = np.array([freedom.axis for freedom in freedoms] + [np.full(3, np.nan)])[:2]
    if len(kinds) == 1:
        return kinds[0], freedoms[0].point, axes
    if kinds not in (2 * ["hinge"], 3 * ["hinge"]):
        return "-".join(kinds), freedoms[0].point, axes
    directions = np.array([freedom.axis for freedom in freedoms])
    # the point that is nearest to the axes of all hinges
    normal_matrix = sum(np.eye(3) - np.outer(axis, axis) for axis in directions)
    right_hand_side = sum((np.eye(3) - np.outer(f.axis, f.axis)) @ f.point for f in freedoms)
    point = np.linalg.lstsq(normal_matrix, right_hand_side, rcond=None)[0]
    distance = max(float(np.linalg.norm(np.cross(f.axis, point - f.point))) for f in freedoms)
    names = ", ".join(freedom.name for freedom in freedoms)
    if distance > SAME:
        raise RobotFileError(
            f"the axes of the hinges {names} are {2 * distance:.3g} m apart, must meet in a point"
        )
    if len(kinds) == 2:
        cosine = abs(float(directions[0] @ directions[1]))
        if cosine > SAME:
            raise RobotFileError(
                f"the hinges {names} are {np.degrees(np.arcsin(cosine)):.3g} deg from "
                "perpendicular to each other"
            )
        return "universal", point, axes
    if abs(np.linalg.det(directions)) < 1e-3:
        raise RobotFileError(
            f"the axes of the hinges {names} are in one plane at home, and form no ball joint there"
        )
    return "ball", point, axes


def _reached(mechanism: Mechanism, start: int, walls: set[int]) -> set[int]:
    """Bodies that are connected to `start` without passing through the bodies in `walls`."""
    reached = {start}
    pending = [start]
    while pending:
        body = pending.pop()
        for c in mechanism.connections:
            if body in (c.first, c.second) and c.other(body) not in reached | walls:
                reached.add(c.other(body))
                pending.append(c.other(body))
    return reached


def _hub(
    solids: list[Solid], connections: list[Connection], limit: float
) -> tuple[int, tuple[Connection, Connection]] | None:
    """Number and connections of a body that is only part of a joint, or None.

    Such a body has a mass of at most `limit`, kg, and two connections, which consist of hinges.
    """
    for body in range(1, len(solids)):
        joined = [c for c in connections if body in (c.first, c.second)]
        if (
            len(joined) == 2
            and solids[body].mass <= limit
            and all(freedom.kind == "hinge" for c in joined for freedom in c.freedoms)
        ):
            return body, (joined[0], joined[1])
    return None


def _moved(connections: list[Connection], gone: Connection, old: int, new: int) -> list[Connection]:
    """Connections without `gone`, in which body `new` replaces body `old`."""
    kept = [c for c in connections if c is not gone]
    numbers = {old: new}
    return [
        Connection(numbers.get(c.first, c.first), numbers.get(c.second, c.second), c.freedoms)
        for c in kept
    ]


def _together(a: Solid, b: Solid) -> Solid:
    """Merge two bodies into one, with the axes of the first."""
    mass = a.mass + b.mass
    centre = (a.mass * a.centre + b.mass * b.centre) / mass if mass else a.centre
    inertia = np.zeros((3, 3))
    for solid in (a, b):
        shift = solid.centre - centre
        inertia += solid.inertia + solid.mass * (shift @ shift * np.eye(3) - np.outer(shift, shift))
    name = a.name if not b.mass else f"{a.name}+{b.name}"
    return Solid(name, mass, centre, inertia, a.axes, a.rod or b.rod, a.shapes + b.shapes)
