"""Check of the encoders against measured poses: wrong signs, wrong units and swapped cables."""

from math import pi

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.geometry.static_poses import StaticPoses

WRONG = 0.2
"""Largest allowed difference between read and expected motion, as a share of the expected."""

STILL = 0.1
"""Smallest expected motion (rms) to which a difference is related, as a share of the travel."""

UNITS = {
    False: {
        "in degrees": 180 / pi,
        "in mrad": 1e3,
        "in turns": 0.5 / pi,
        "taken for degrees": pi / 180,
    },
    True: {"in mm": 1e3, "in um": 1e6, "in inches": 1 / 0.0254, "taken for mm": 1e-3},
}
"""Factors of readings in wrong units. The key is True for sliding actuators."""


def check_encoders(robot: Robot, data: StaticPoses) -> None:
    """Compare the readings of the encoders with the nominal joint coordinates at the poses.

    Raises RecordError if a joint moves differently. The message states what would fit: the opposite
    sign, another unit, or the readings of another joint. A constant offset is allowed. Raises
    UnreachablePoseError, naming leg and pose, for a pose that the nominal robot cannot reach.
    """
    chart = robot.geometry.chart
    poses = chart.pose(chart.coordinates(data.poses))
    robot.check_reach(poses, "measured pose", "pose")
    expected = robot.inverse_kinematics(poses)
    moves, readings = (values - values.mean(axis=0) for values in (expected, data.joints))
    still = STILL * robot.travel_limit
    wrong = [
        k
        for k in range(len(robot.joint_names))
        if _left(moves[:, k], readings[:, k], still) > WRONG
    ]
    if wrong:
        said = "; ".join(
            f"{robot.joint_names[k]} {_what_fits(robot, moves, readings, k)}" for k in wrong
        )
        raise RecordError(f"encoder readings do not fit the motion of {robot.name}: {said}")


def _what_fits(robot: Robot, moves: Array, readings: Array, joint: int) -> str:
    factors = {"": 1.0, **UNITS[robot.layout.prismatic]}
    still = STILL * robot.travel_limit
    found: list[tuple[float, bool, bool, str, int]] = [
        (
            _left(sign * factor * moves[:, joint], readings[:, other], factor * still),
            other != joint,
            sign < 0,
            unit,
            other,
        )
        for unit, factor in factors.items()
        for sign in (1, -1)
        for other in range(readings.shape[1])
    ]
    # Among equal fits the simplest is chosen, because False sorts before True.
    left, swapped, opposite, unit, other = min(found)
    if left > WRONG:
        off = _left(moves[:, joint], readings[:, joint], still)
        return f"is {off:.0%} of its motion off, and no sign, unit or order fits"
    what = [f"with the readings of {robot.joint_names[other]}"] if swapped else []
    what += ["with the opposite sign"] if opposite else []
    what += [f"as readings {unit}"] if unit else []
    return f"fits {' and '.join(what)}"


def _left(expected: Array, read: Array, still: float) -> float:
    """Return the norm of the unexplained motion, relative to that of the expected motion.

    If the rms of the expected motion is less than `still`, `still` is used in its place.
    """
    least = still * len(expected) ** 0.5
    return float(np.linalg.norm(read - expected) / max(float(np.linalg.norm(expected)), least))
