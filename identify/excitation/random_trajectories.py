"""Random trajectories that a robot can be given: inside its travel and the other limits."""

from collections.abc import Callable

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.motion import SAMPLES_PER_HARMONIC
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory, check_travel, random_trajectory

ATTEMPTS = 50
"""Random trajectories tried, on the average, for each one that has to be admissible."""

Check = Callable[[FourierTrajectory, Array], object]
"""Raises TrajectoryError for a trajectory that is not admissible at some instants (N,) [s]."""


def admissible_trajectories(
    robot: Robot,
    settings: Excitation,
    duration_s: float,
    count: int,
    seed: np.random.SeedSequence,
    check: Check = lambda trajectory, times: None,
) -> list[FourierTrajectory]:
    """Random trajectories that stay inside the travel less the margin and pass `check`.

    Raises TrajectoryError, with the last reason, when too few of them do.
    """
    rng = np.random.default_rng(seed)
    rate_hz = 4 * SAMPLES_PER_HARMONIC * settings.harmonics * settings.fundamental_hz
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    accepted: list[FourierTrajectory] = []
    reason = TrajectoryError("none tried")
    for _ in range(ATTEMPTS * count):
        candidate = random_trajectory(
            rng,
            robot.home_pose,
            settings.fundamental_hz,
            settings.harmonics,
            settings.position_amplitude_m,
            settings.orientation_amplitude_rad,
        )
        try:
            check_travel(robot, candidate, t, settings.travel_margin_rad)
            check(candidate, t)
        except TrajectoryError as error:
            reason = error
            continue
        accepted.append(candidate)
        if len(accepted) == count:
            return accepted
    raise TrajectoryError(
        f"only {len(accepted)} of {ATTEMPTS * count} random trajectories of ±{settings.position_amplitude_m:g} m and "
        f"±{settings.orientation_amplitude_rad:g} rad stay inside the travel and the other limits, {count} are needed; "
        f"the last: {reason}"
    )
