"""Whether a record is one of this robot, from rest, in m and rad: rules that no shape and no type
can show.
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
"""Share of the largest travel of the positions, or of the angles, by which the first measured pose
may be away.
"""

TRAVELS = 2.0
"""Travels by which a measured pose may be away from the reference, and a command from where that
puts the joints.
"""

BUILT = 0.05
"""Share of the joints' travel limit by which a robot that is built otherwise than its file may need
other commands.
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

    measured: poses (N, 6), NaN where lost; ok (N,); logged: joint commands (N, n), if any.
    Raises EstimationError, with the frame, what was found, and units in which it would fit.
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
        raise EstimationError(
            f"the record does not begin at rest: the rate of {POSE[worst]} in its first frame is "
            f"{first[worst]:.3g} "
            f"{'m/s' if worst < 3 else 'rad/s'}, {100 * first[worst] / largest[worst]:.0f} % of "
            "its largest; begin the "
            "record where the robot stood still"
        )


def _check_measured(reference: Reference, measured: Array, ok: NDArray[np.bool_]) -> None:
    """The measured poses stay within some travels of the reference, and begin where it does."""
    travel = np.repeat(np.ptp(reference.poses, axis=0).reshape(2, 3).max(axis=1), 3)
    # of angles that nobody asked to move nothing is known
    usual = np.where(travel > 0, travel, np.inf)
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
            "reference "
            f"{reference.poses[frame, worst]:.6g}, {100 * found[frame, worst]:.0f} % of its "
            f"travel apart: {rest}both "
            f"are in different frames or units{_unit_hint(measured, near)}"
        )


def _check_commands(robot: Robot, reference: Reference, logged: Array) -> None:
    wanted = robot.inverse_kinematics(reference.poses)
    travel = float(np.ptp(wanted, axis=0).max())
    allowed = max(TRAVELS * travel, BUILT * robot.geometry.travel_limit)

    def follows(commands: Array) -> bool:
        return bool(np.abs(commands - wanted).max() <= allowed)

    if not follows(logged):
        frame, joint = np.unravel_index(int(np.argmax(np.abs(logged - wanted))), logged.shape)
        other, factor = ("mm", 1e-3) if robot.layout.prismatic else ("degrees", np.pi / 180)
        unit = "m" if robot.layout.prismatic else "rad"
        hint = (
            f"; in {other} it would fit, and records are in {unit}"
            if follows(factor * logged)
            else ""
        )
        raise EstimationError(
            f"the command of joint {joint + 1} in frame {frame} is {logged[frame, joint]:.6g}, "
            "and the reference needs "
            f"{wanted[frame, joint]:.6g} {unit}, more than {allowed:.3g} {unit} away: zero, "
            "direction or unit of the "
            f"joints differ from the robot file's{hint}"
        )


def _unit_hint(poses: Array, fits: Callable[[Array], bool]) -> str:
    """In which units poses (N, 6) would fit; empty where in none."""
    for units, (position, angle) in OTHER_UNITS.items():
        if fits(poses * np.repeat([position, angle], 3)):
            return f"; in {units} it would fit, and records are in m and rad"
    return ""
