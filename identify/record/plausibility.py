"""Checks that a record is of this robot, begins at rest, and is in m and rad.

No shape and no type can show that.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import Reference
from dynamics.errors import UnreachablePoseError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.files.dataset import POSE

REST_RATE = 0.05
"""Share of its largest rate with which a reference may begin."""

REST_POSE = 0.1
"""Distance from the reference at which the first measured pose may be.

It is a share of the largest travel of the positions, or of the angles.
"""

TRAVELS = 2.0
"""Distance, in travels, at which a measured pose may be from the reference.

A command may be as far from the joint coordinates of the reference.
"""

BUILT = 0.05
"""Share of the joints' travel limit by which commands may differ from those of the robot file.

A robot that is built otherwise than its file needs other commands.
"""

OTHER_UNITS = {
    "mm": (1e-3, 1.0),
    "degrees": (1.0, np.pi / 180),
    "mm and degrees": (1e-3, np.pi / 180),
}
"""Factors of positions and of angles from units in which records come by mistake."""


def check_plausible(
    robot: Robot, reference: Reference, measured: Array, ok: NDArray[np.bool_], logged: Array | None
) -> None:
    """Refuse a record that does not begin at rest, or is in other units or frames than the robot.

    measured (N, 6): poses, NaN where lost. ok (N,): frames that were measured. logged (N, n): joint
    commands, if any. Raises EstimationError with the frame, what was found, and units in which it
    would fit.
    """
    _check_reach(robot, reference.poses)
    _check_rest(reference)
    _check_measured(reference, measured, ok)
    if logged is not None:
        _check_commands(robot, reference, logged)


def _check_reach(robot: Robot, poses: Array) -> None:
    def reached(one: Array) -> bool:
        return bool((robot.reach_margin(one) > 0).all())

    if not reached(poses):
        try:
            robot.check_reach(poses, "the reference", "frame")
        except UnreachablePoseError as error:
            raise EstimationError(f"{error}{_unit_hint(poses, reached)}") from None


def _check_rest(reference: Reference) -> None:
    first = np.abs(reference.rates[0])
    largest = np.abs(reference.rates).max(axis=0)
    worst = int(np.argmax(first - REST_RATE * largest))
    if first[worst] > REST_RATE * largest[worst]:
        unit = "m/s" if worst < 3 else "rad/s"
        raise EstimationError(
            f"the record does not begin at rest: the rate of {POSE[worst]} in its first frame is "
            f"{first[worst]:.3g} {unit}, {100 * first[worst] / largest[worst]:.0f} % of its "
            "largest; begin the record where the robot stood still"
        )


def _check_measured(reference: Reference, measured: Array, ok: NDArray[np.bool_]) -> None:
    """Check that the measured poses stay near the reference, and begin where it does."""
    travel = np.repeat(np.ptp(reference.poses, axis=0).reshape(2, 3).max(axis=1), 3)
    # angles that nobody asked to move have no travel to compare with
    usual = np.where(travel > 0, travel, np.inf)
    # only at rest, in the first frame, must the robot be where the reference is
    limits = np.full(len(ok), TRAVELS)
    limits[0] = REST_POSE

    def gaps(poses: Array) -> Array:
        return np.asarray(np.where(ok[:, None], np.abs(poses - reference.poses), 0.0) / usual)

    def near(poses: Array) -> bool:
        return bool((gaps(poses) <= limits[:, None]).all())

    if not near(measured):
        found = gaps(measured)
        frame = int(np.argmax(found.max(axis=1) > limits))
        worst = int(np.argmax(found[frame]))
        rest = "the record does not begin at rest, or " if frame == 0 else ""
        raise EstimationError(
            f"in frame {frame} the measured {POSE[worst]} is {measured[frame, worst]:.6g} and the "
            f"reference {reference.poses[frame, worst]:.6g}, {100 * found[frame, worst]:.0f} % of "
            f"its travel apart: {rest}both are in different frames or "
            f"units{_unit_hint(measured, near)}"
        )


def _check_commands(robot: Robot, reference: Reference, logged: Array) -> None:
    wanted = robot.inverse_kinematics(reference.poses)
    travel = float(np.ptp(wanted, axis=0).max())
    allowed = max(TRAVELS * travel, BUILT * robot.geometry.travel_limit)

    def follows(commands: Array) -> bool:
        return bool(np.abs(commands - wanted).max() <= allowed)

    if not follows(logged):
        frame, joint = np.unravel_index(int(np.argmax(np.abs(logged - wanted))), logged.shape)
        prismatic = robot.layout.prismatic
        unit = "m" if prismatic else "rad"
        other = "mm" if prismatic else "degrees"
        factor = 1e-3 if prismatic else np.pi / 180
        hint = ""
        if follows(factor * logged):
            hint = f"; in {other} it would fit, and records are in {unit}"
        raise EstimationError(
            f"the command of joint {joint + 1} in frame {frame} is {logged[frame, joint]:.6g}, and "
            f"the reference needs {wanted[frame, joint]:.6g} {unit}, more than {allowed:.3g} "
            f"{unit} away: zero, direction or unit of the joints differ from the robot file's{hint}"
        )


def _unit_hint(poses: Array, fits: Callable[[Array], bool]) -> str:
    """Return a hint at units in which poses (N, 6) would fit, or an empty string."""
    for units, (position, angle) in OTHER_UNITS.items():
        if fits(poses * np.repeat([position, angle], 3)):
            return f"; in {units} it would fit, and records are in m and rad"
    return ""
