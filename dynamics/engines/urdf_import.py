"""Import of a robot from a URDF file, and a YAML file with its closed loops.

The convention is that of the public collection example-parallel-robots. A URDF file describes a
tree, whose root is the fixed base. The YAML file has these keys:

- closed_loop: pairs of frames that coincide. A frame is named by a link, or by a joint, which
  stands for the frame of its child.
- type: for each pair, "3d" if only the points coincide, or "6d" (the default) if the axes coincide,
  too.
- name_mot: the actuated joints.
- joint_name and joint_type: joints with another type than in the URDF file, and these types. A type
  is SPHERICAL, FIXED, or, for example, UJOINT_XY (hinges about x, then y, of the joint's frame).

Home is the configuration near zero coordinates in which the loops are closed.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dynamics.checks import shown
from dynamics.engines.mechanism import Connection, Freedom, Mechanism, Solid
from dynamics.engines.recognition import recognised
from dynamics.engines.urdf_elements import mesh_shapes, number_in, numbers, origin, real_in
from dynamics.errors import RobotFileError
from dynamics.files import LARGEST_XML, LARGEST_YAML, parse_xml, parse_yaml, read_bytes
from dynamics.legs.chain import SAME
from dynamics.robot_file import RobotDescription

KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
# Largest number of links, and of joints, of a robot. The largest example has about forty.
MOST = 120
# Largest number of all joint coordinates. The time to close loops grows with its square.
MOST_COORDINATES = 90
MOST_ITERATIONS = 60  # largest number of evaluations to close the loops; about ten are usual
GRAVITY = np.array([0.0, 0.0, -9.81])  # gravity, m/s^2, which URDF does not state
# Number of coordinates of each kind of joint.
COORDINATES = {"hinge": 1, "slide": 1, "ball": 3, "weld": 0, "universal": 2, "floating": 6}

# Kind of joint for each joint type of URDF.
KINDS = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "fixed": "weld",
    "floating": "floating",
}


@dataclass(frozen=True)
class _Joint:
    """Joint of the tree.

    `place` (4, 4) is its frame in the frame of the parent at coordinate zero. `axes` (2, 3) are its
    axes in its own frame; only a universal joint uses the second. `friction` has the dry and the
    viscous friction. `span` is the range of its coordinate, or None if the file states none.
    """

    name: str
    kind: str
    parent: str
    child: str
    place: np.ndarray
    axes: np.ndarray
    friction: tuple[float, float]
    span: tuple[float, float] | None

    def moved(self, q: np.ndarray) -> np.ndarray:
        """Frame (4, 4) of the child in the frame of the parent, at joint coordinates `q`."""
        motion = np.eye(4)
        if self.kind in ("ball", "floating"):
            motion[:3, :3] = Rotation.from_rotvec(q[-3:]).as_matrix()
            motion[:3, 3] = q[:-3] if self.kind == "floating" else 0.0
        elif self.kind == "slide":
            motion[:3, 3] = q[0] * self.axes[0]
        else:
            for angle, axis in zip(q, self.axes, strict=False):
                motion[:3, :3] = motion[:3, :3] @ Rotation.from_rotvec(angle * axis).as_matrix()
        return np.asarray(self.place @ motion)


def robot_of_urdf(path: str | Path, closures: str | Path) -> tuple[RobotDescription, list[str]]:
    """Robot in a URDF file and a YAML file with its closed loops, and remarks on the files.

    Raises RobotFileError for a file that cannot be read, for loops that do not close, and for legs
    of no known kind.
    """
    settings = _closures(closures)
    content = read_bytes(path, str(path), RobotFileError, LARGEST_XML)
    root = parse_xml(content, str(path), RobotFileError)
    try:
        return recognised(_mechanism(root, settings, Path(path).absolute().parent))
    except RobotFileError as error:
        raise RobotFileError(f"{path} with {closures}: {error}") from None


def _closures(path: str | Path) -> dict[str, list[Any]]:
    """Settings in the YAML file. Raises RobotFileError if they are invalid."""
    data = read_bytes(path, str(path), RobotFileError, LARGEST_YAML)
    content = parse_yaml(data, str(path), RobotFileError)
    if (
        not isinstance(content, Mapping)
        or "closed_loop" not in content
        or "name_mot" not in content
    ):
        raise RobotFileError(
            f"{path} needs closed_loop and name_mot, lists of names; got {shown(content)}"
        )
    for key, value in content.items():
        if key not in KEYS or not isinstance(value, list):
            raise RobotFileError(f"{path}: {key} is unknown or no list; valid: {', '.join(KEYS)}")
    settings = {key: list(content.get(key, [])) for key in KEYS}
    for key in ("type", "name_mot", "joint_name", "joint_type"):
        for name in settings[key]:
            if not isinstance(name, str):
                raise RobotFileError(f"{path}: {key} has {shown(name)}, must be a list of names")
    for key in ("name_mot", "joint_name"):
        _require_once(settings[key], f"{path}: {key}")
    settings["type"] = settings["type"] or ["6d"] * len(settings["closed_loop"])
    for first, second in (("closed_loop", "type"), ("joint_name", "joint_type")):
        if len(settings[first]) != len(settings[second]):
            raise RobotFileError(
                f"{path}: {len(settings[first])} {first}, but {len(settings[second])} {second}"
            )
    return settings


def _require_once(names: list[str], what: str) -> None:
    """Raise RobotFileError if a name appears more than once."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise RobotFileError(f"{what} has {shown(twice[0])} more than once")


def _mechanism(root: Xml.Element, settings: dict[str, list[Any]], folder: Path) -> Mechanism:
    elements = {kind: root.findall(kind) for kind in ("link", "joint")}
    for kind, found in elements.items():
        if len(found) > MOST:
            raise RobotFileError(f"it has {len(found)} elements {kind}, a robot has at most {MOST}")
        _require_once([str(element.get("name")) for element in found], f"the name of a {kind}")
    new_types = dict(zip(settings["joint_name"], settings["joint_type"], strict=True))
    joints = [_joint(element, new_types.get(element.get("name"))) for element in elements["joint"]]
    links = {str(element.get("name")): element for element in elements["link"]}
    ordered = _from_the_root(links, joints)
    base = ordered[0].parent if ordered else ""
    frames = {joint.name: joint.child for joint in joints} | {name: name for name in links}
    loops = []
    for pair, kind in zip(settings["closed_loop"], settings["type"], strict=True):
        if not (isinstance(pair, list) and len(pair) == 2 and all(name in frames for name in pair)):
            raise RobotFileError(
                f"closed_loop {pair} must be two names of links or joints of the URDF"
            )
        if str(kind).lower() not in ("3d", "6d"):
            raise RobotFileError(f"type {kind!r} of closed_loop {pair} is unknown; valid: 3d, 6d")
        loops.append((frames[pair[0]], frames[pair[1]], str(kind).lower() == "6d"))
    for name in settings["name_mot"]:
        if name not in {joint.name for joint in joints if joint.kind in ("hinge", "slide")}:
            raise RobotFileError(f"name_mot {name} is no joint of the URDF that turns or slides")
    q = _closed(base, ordered, loops)
    place = _placed(base, ordered, q)
    slices = _slices(ordered)
    number = {name: k for k, name in enumerate([base, *(joint.child for joint in ordered)])}
    motors = {name: k for k, name in enumerate(settings["name_mot"])}
    connections = [
        Connection(
            number[joint.parent],
            number[joint.child],
            _freedoms(
                joint,
                place[joint.parent] @ joint.place,
                q[slices[joint.name]],
                motors.get(joint.name),
            ),
        )
        for joint in ordered
        if joint.kind != "floating"
    ]
    for a, b, welded in loops:
        ball = Freedom("ball", f"closed_loop {a}, {b}", place[a][:3, 3], np.full(3, np.nan))
        connections.append(Connection(number[a], number[b], () if welded else (ball,)))
    solids = [
        replace(
            _solid(links[name], place[name]), shapes=mesh_shapes(links[name], place[name], folder)
        )
        for name in number
    ]
    ranges = {joint.name: joint.span for joint in joints if joint.span is not None}
    return Mechanism(str(root.get("name") or "robot"), solids, connections, GRAVITY, ranges)


def _joint(element: Xml.Element, new_type: str | None) -> _Joint:
    """Joint of an XML element. `new_type` is its type in the YAML file, or None.

    Raises RobotFileError for a joint that is incomplete or of an unknown type.
    """
    name = str(element.get("name"))
    kind = str(element.get("type"))
    if kind not in KINDS or element.find("mimic") is not None:
        raise RobotFileError(
            f"joint {name} is of type {kind} or mimics another; valid: {', '.join(KINDS)}"
        )
    own_kind = KINDS[kind]
    axes = np.array([numbers(element, "axis", "xyz", (1.0, 0.0, 0.0)), np.zeros(3)])
    if new_type is not None and re.fullmatch("UJOINT_[XYZ]{2}", new_type):
        own_kind = "universal"
        axes = np.array([np.eye(3)["XYZ".index(letter)] for letter in new_type[7:]])
    elif new_type is not None:
        if new_type not in ("SPHERICAL", "FIXED"):
            raise RobotFileError(
                f"joint_type {new_type} of {name} is unknown; valid: SPHERICAL, FIXED, UJOINT_XY"
            )
        own_kind = {"SPHERICAL": "ball", "FIXED": "weld"}[new_type]
    length = np.linalg.norm(axes[0])
    if own_kind in ("hinge", "slide") and not length > 0:
        raise RobotFileError(f"joint {name} has an axis of length {length:g}")
    ends = [element.find(end) for end in ("parent", "child")]
    if any(end is None or end.get("link") is None for end in ends):
        raise RobotFileError(f"joint {name} needs parent and child")
    friction = (
        number_in(element, "dynamics", "friction"),
        number_in(element, "dynamics", "damping"),
    )
    limit = element.find("limit")
    span = None
    if kind != "continuous" and limit is not None and limit.get("lower") and limit.get("upper"):
        span = (number_in(element, "limit", "lower"), number_in(element, "limit", "upper"))
    parent, child = (str(end.get("link")) for end in ends if end is not None)
    return _Joint(
        name, own_kind, parent, child, origin(element), axes / max(length, 1e-300), friction, span
    )


def _from_the_root(links: Mapping[str, Xml.Element], joints: list[_Joint]) -> list[_Joint]:
    """Sort joints so that each follows the joint of its parent link.

    Raises RobotFileError if links and joints form no tree.
    """
    children = [joint.child for joint in joints]
    roots = [name for name in links if name not in children]
    missing = sorted(
        {name for joint in joints for name in (joint.parent, joint.child)} - set(links)
    )
    if len(roots) != 1 or missing or len(set(children)) != len(children):
        raise RobotFileError(
            f"the URDF is no tree: roots {', '.join(roots) or 'none'}, unknown links "
            f"{', '.join(missing) or 'none'}"
        )
    below: dict[str, list[int]] = {}
    for k, joint in enumerate(joints):
        below.setdefault(joint.parent, []).append(k)
    ordered: list[_Joint] = []
    # a heap, so that the next joint is the first in the file among all that can follow
    next_ones = list(below.get(roots[0], ()))
    while next_ones:
        joint = joints[heappop(next_ones)]
        ordered.append(joint)
        for k in below.get(joint.child, ()):
            heappush(next_ones, k)
    if len(ordered) < len(joints):
        raise RobotFileError("the URDF is no tree: some links form a loop")
    return ordered


def _placed(base: str, joints: list[_Joint], q: np.ndarray) -> dict[str, np.ndarray]:
    """Frames base_from_link (4, 4) of all links at coordinates `q`, by name."""
    place = {base: np.eye(4)}
    slices = _slices(joints)
    for joint in joints:
        place[joint.child] = place[joint.parent] @ joint.moved(q[slices[joint.name]])
    return place


def _slices(joints: list[_Joint]) -> dict[str, slice]:
    """Slice of each joint in the vector of all coordinates, by name."""
    ends = np.cumsum([COORDINATES[joint.kind] for joint in joints]).tolist()
    return {
        joint.name: slice(end - COORDINATES[joint.kind], end)
        for joint, end in zip(joints, ends, strict=True)
    }


def _closed(base: str, joints: list[_Joint], loops: list[tuple[str, str, bool]]) -> np.ndarray:
    """Coordinates at which all loops are closed.

    Raises RobotFileError if a gap remains, m or rad, or for more than MOST_COORDINATES coordinates.
    """

    def gaps(q: np.ndarray) -> np.ndarray:
        place = _placed(base, joints, q)
        differences = [np.zeros(1)]
        for a, b, welded in loops:
            differences.append(place[a][:3, 3] - place[b][:3, 3])
            if welded:
                differences.append(
                    Rotation.from_matrix(place[a][:3, :3].T @ place[b][:3, :3]).as_rotvec()
                )
        return np.concatenate(differences)

    q = np.zeros(sum(COORDINATES[joint.kind] for joint in joints))
    if len(q) > MOST_COORDINATES:
        raise RobotFileError(
            f"its joints have {len(q)} coordinates, a robot has at most {MOST_COORDINATES}"
        )
    if np.abs(gaps(q)).max() > SAME**2:
        q = least_squares(gaps, q, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=MOST_ITERATIONS).x
    worst = float(np.abs(gaps(q)).max())
    if worst > SAME:
        raise RobotFileError(
            f"the loops do not close: a gap of {worst:.3g} m or rad remains, must be below {SAME:g}"
        )
    return q


def _freedoms(
    joint: _Joint, at: np.ndarray, q: np.ndarray, actuator: int | None
) -> tuple[Freedom, ...]:
    """Elementary joints of a joint at its coordinates `q`.

    `at` (4, 4) is the frame of the joint in the base.
    """
    point = at[:3, 3]
    turn = at[:3, :3]
    first = turn @ joint.axes[0]
    if joint.kind == "ball":
        return (Freedom("ball", joint.name, point, np.full(3, np.nan), friction=joint.friction),)
    if joint.kind == "universal":
        second = turn @ Rotation.from_rotvec(q[0] * joint.axes[0]).apply(joint.axes[1])
        both = zip("12", (first, second), strict=True)
        return tuple(
            Freedom("hinge", f"{joint.name} {k}", point, axis, friction=joint.friction)
            for k, axis in both
        )
    if joint.kind == "weld":
        return ()
    return (Freedom(joint.kind, joint.name, point, first, float(q[0]), joint.friction, actuator),)


def _solid(link: Xml.Element, place: np.ndarray) -> Solid:
    """Body of a link. A link without an inertial element has no mass.

    The drawn rod of the body is the first cylinder among its visuals.
    """
    name = str(link.get("name"))
    axes = place[:3, :3]
    inertial = link.find("inertial")
    shape = link.find("visual/geometry/cylinder")
    rod = None if shape is None else (real_in(shape, "length"), real_in(shape, "radius"))
    if inertial is None:
        return Solid(name, 0.0, place[:3, 3], np.zeros((3, 3)), axes, rod)
    frame = place @ origin(inertial)
    tensor = inertial.find("inertia")
    if tensor is None:
        raise RobotFileError(f"link {name} has an inertial without inertia")
    rows = [[real_in(tensor, f"i{min(a, b)}{max(a, b)}") for b in "xyz"] for a in "xyz"]
    turned = frame[:3, :3] @ np.array(rows) @ frame[:3, :3].T
    return Solid(name, number_in(inertial, "mass", "value"), frame[:3, 3], turned, axes, rod)
