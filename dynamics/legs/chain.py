"""Leg from its chain of joints at home, as files of other programs describe it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from dynamics.errors import RobotFileError
from dynamics.legs.crank_legs import ParallelogramLeg, RrrLeg, RssLeg, RusLeg
from dynamics.legs.leg import Leg
from dynamics.legs.pss import PssLeg, PusLeg
from dynamics.legs.ups import UpsLeg

# Difference of angles, rad, and distances, m, below which they count as equal. It allows for
# numbers that are written with few digits.
SAME = 1e-6


class Chain(NamedTuple):
    """Joints of a leg at home, in order from the base. Vectors are in the axes of the base, m.

    `joints` are the kinds of the k joints: "hinge", "slide", "universal" or "ball", with * for the
    actuated one. `points` (k, 3) are their positions, midway between the bars if there are two. The
    last is the platform joint A. `axes` (k, 2, 3) are the axis of each joint, and the second axis
    of a universal joint. `coordinate` is that of the actuated joint at home, rad or m.
    `platform_joint` (3,) is A in the axes of the platform. `across` (3,) is the vector from the
    first of two bars to the second, or zero. `centres` (k - 1, 3) are the centres of mass of the
    bodies. `rods` has the length and radius of the drawn rod of each body, None if it has no rod.
    """

    joints: tuple[str, ...]
    points: np.ndarray
    axes: np.ndarray
    coordinate: float
    platform_joint: np.ndarray
    across: np.ndarray
    centres: np.ndarray
    rods: list[tuple[float, float] | None]

    @property
    def signature(self) -> str:
        """Joints as text, in the form of `SIGNATURES`."""
        first, *others = self.joints
        return f"{first} 2 x ({' '.join(others)})" if self.across.any() else " ".join(self.joints)


def leg_of(chain: Chain) -> Leg:
    """Leg with the joints of a chain, on the branch that the chain has at home.

    Raises RobotFileError, with the valid kinds, if the joints form no kind of leg. Raises it, with
    the deviation or the number, if the joints are not placed as their kind requires.
    """
    if chain.signature not in SIGNATURES:
        kinds = ", ".join(
            f"{kind.model_fields['type'].default} = {text}"
            for text, (kind, _) in SIGNATURES.items()
        )
        raise RobotFileError(
            f"its joints, {chain.signature}, make no kind of leg (*: actuated); valid: {kinds}"
        )
    kind, fields = SIGNATURES[chain.signature]
    try:
        leg = kind.model_validate(fields(chain) | {"platform_joint": chain.platform_joint})
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, item['loc']))} = {item['input']}: {item['msg']}"
            for item in error.errors()
        ]
        raise RobotFileError("; ".join(problems)) from None
    branches: list[Leg] = [leg.model_copy(update={"branch": sign}) for sign in (1, -1)]
    differences = [
        float(each.coordinate(ca.SX(chain.points[-1]))) - chain.coordinate for each in branches
    ]
    if not leg.prismatic:
        differences = [(value + np.pi) % (2 * np.pi) - np.pi for value in differences]
    best = int(np.argmin(np.nan_to_num(np.abs(differences), nan=np.inf)))
    if not abs(differences[best]) < SAME:
        raise RobotFileError(
            f"its coordinate at home is {chain.coordinate:g}, but its geometry gives "
            f"{chain.coordinate + differences[best]:g}"
        )
    return branches[best]


def _cranked(chain: Chain) -> dict[str, Any]:
    """Fields of a crank, and of a link that begins at its tip."""
    tip = chain.points[1]
    axis = chain.axes[0, 0]
    base = chain.points[0] + ((tip - chain.points[0]) @ axis) * axis
    length = float(np.linalg.norm(tip - base))
    if length < SAME:
        raise RobotFileError(
            f"its crank is {length:.3g} m long: its first two joints are on one axis"
        )
    zero = Rotation.from_rotvec(-chain.coordinate * axis).apply((tip - base) / length)
    zero -= (zero @ axis) * axis
    return {
        "base_joint": base,
        "crank_axis": axis,
        "crank_zero_direction": zero / np.linalg.norm(zero),
        "crank_length": length,
        "link_length": float(np.linalg.norm(chain.points[2] - tip)),
        **_drawn(chain, "crank", "link"),
    }


def _with_universal_joint(chain: Chain) -> dict[str, Any]:
    """Fields of a crank, and of a link on a universal joint."""
    _check_parallel(
        "the first axis of its universal joint", chain.axes[1, 0], "the crank's", chain.axes[0, 0]
    )
    _check_second_axis(chain, 1)
    return _cranked(chain)


def _parallelogram(chain: Chain) -> dict[str, Any]:
    """Fields of a crank, and of a link of two bars."""
    _check_parallel("the line from bar to bar", chain.across, "the crank's axis", chain.axes[0, 0])
    return _cranked(chain) | {"bar_distance": float(np.linalg.norm(chain.across))}


def _planar(chain: Chain) -> dict[str, Any]:
    """Fields of a chain of parallel hinges. Their positions along their axes have no effect."""
    axis = chain.axes[0, 0]
    for joint, name in enumerate(chain.joints):
        if name == "hinge":
            _check_parallel(
                f"the axis of its joint {joint + 1}", chain.axes[joint, 0], "the crank's axis", axis
            )
    flat = chain.points - np.outer((chain.points - chain.points[-1]) @ axis, axis)
    return _cranked(chain._replace(points=flat))


def _sliding(chain: Chain) -> dict[str, Any]:
    """Fields of a slider and a link."""
    slider, end = chain.points[1:3]
    fields = {
        "base_joint": slider - chain.coordinate * chain.axes[0, 0],
        "slider_axis": chain.axes[0, 0],
        "link_length": float(np.linalg.norm(end - slider)),
        **_drawn(chain, "slider", "link"),
    }
    if chain.rods[0] is not None:
        fields["slider_length"] = chain.rods[0][0]
    if chain.joints[1] == "universal":
        _check_second_axis(chain, 1)
        fields["joint_axis"] = chain.axes[1, 0]
    return fields


def _telescopic(chain: Chain) -> dict[str, Any]:
    """Fields of a cylinder and its rod.

    A length that the file does not have is 2/3 of the distance from B to A at home. If both are
    missing, home is thus at mid-stroke.
    """
    base, _, end = chain.points
    length = float(np.linalg.norm(end - base))
    _check_parallel("its slide", chain.axes[1, 0], "the line through its ends", end - base)
    _check_second_axis(chain, 0)
    if chain.axes[1, 0] @ (end - base) < 0:
        raise RobotFileError(
            "its coordinate grows as the leg gets shorter: reverse the axis of its slide"
        )
    lengths = [length / 1.5 if rod is None else rod[0] for rod in chain.rods]
    along = (end - base) / length
    return {
        "base_joint": base,
        "joint_axis": chain.axes[0, 0],
        "zero_length": length - chain.coordinate,
        "cylinder_centre": float((chain.centres[0] - base) @ along),
        "rod_centre": float((end - chain.centres[1]) @ along),
        "cylinder_length": lengths[0],
        "rod_length": lengths[1],
        **_drawn(chain, "cylinder", "rod"),
    }


def _drawn(chain: Chain, *names: str) -> dict[str, float]:
    """Radii of the drawn rods, as fields of a leg."""
    return {
        f"{name}_radius": rod[1]
        for name, rod in zip(names, chain.rods, strict=True)
        if rod is not None
    }


def _check_second_axis(chain: Chain, joint: int) -> None:
    """Raise RobotFileError unless the second axis of a joint is perpendicular to its body."""
    along = chain.points[-1] - chain.points[joint]
    angle = float(np.arcsin(np.abs(chain.axes[joint, 1] @ along) / np.linalg.norm(along)))
    if angle > SAME:
        raise RobotFileError(
            f"the second axis of its universal joint is {np.degrees(angle):.3g} deg from "
            "perpendicular to the body on it"
        )


def _check_parallel(what: str, direction: np.ndarray, of: str, other: np.ndarray) -> None:
    """Raise RobotFileError unless two directions, named `what` and `of`, are parallel."""
    sine = float(
        np.linalg.norm(np.cross(direction, other))
        / np.linalg.norm(direction)
        / np.linalg.norm(other)
    )
    if sine > SAME:
        raise RobotFileError(
            f"{what} is {np.degrees(np.arcsin(min(sine, 1.0))):.3g} deg from {of}: not parallel"
        )


# Kinds of legs by their joints from the base on, each with the function that gives its fields.
SIGNATURES: dict[str, tuple[type[Leg], Callable[[Chain], dict[str, Any]]]] = {
    "hinge* ball ball": (RssLeg, _cranked),
    "hinge* universal ball": (RusLeg, _with_universal_joint),
    "universal slide* ball": (UpsLeg, _telescopic),
    "slide* ball ball": (PssLeg, _sliding),
    "slide* universal ball": (PusLeg, _sliding),
    "hinge* 2 x (ball ball)": (ParallelogramLeg, _parallelogram),
    "hinge* hinge hinge": (RrrLeg, _planar),
    "hinge* hinge ball": (RrrLeg, _planar),
}
