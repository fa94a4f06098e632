"""Do encoders read what the robot does? Signs, units and cables that are swapped, named by what
fits.
"""

from math import pi

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.geometry.static_poses import StaticPoses

WRONG = 0.2
"""Share of a joint's motion that a geometry within any tolerance leaves unexplained at most."""

STILL = 0.1
"""Share of the travel: a joint that moves less is judged as if it moved so far."""

UNITS = {
    False: {
        "in degrees": 180 / pi,
        "in mrad": 1e3,
        "in turns": 0.5 / pi,
        "taken for degrees": pi / 180,
    },
    True: {"in mm": 1e3, "in um": 1e6, "in inches": 1 / 0.0254, "taken for mm": 1e-3},
}
"""What a reading is multiplied by where actuators turn, and where they slide."""


def check_encoders(robot: Robot, data: StaticPoses) -> None:
    """Raise RecordError for joints that do not move as the nominal robot's do at the measured
    poses, with what fits: the opposite sign, another unit, another joint's readings. Offsets are no
    fault.

    Raises UnreachablePoseError, naming leg and pose, for a pose that the nominal robot cannot
    reach.
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
        raise RecordError(f"encoders do not read what {robot.name} does: {said}")


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
    left, swapped, opposite, unit, other = min(found)
    if left > WRONG:
        off = _left(moves[:, joint], readings[:, joint], still)
        return f"is {off:.0%} of its motion off, and no sign, unit or order fits"
    what = [f"with the readings of {robot.joint_names[other]}"] if swapped else []
    what += ["with the opposite sign"] if opposite else []
    what += [f"as readings {unit}"] if unit else []
    return f"fits {' and '.join(what)}"


def _left(expected: Array, read: Array, still: float) -> float:
    """What is left of readings, as a share of what is expected of them, or of a joint that hardly
    moves.
    """
    least = still * len(expected) ** 0.5
    return float(np.linalg.norm(read - expected) / max(float(np.linalg.norm(expected)), least))
