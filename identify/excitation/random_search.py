"""The exciting trajectory as the best of many random ones by the paper's observability index (eq. 39).

The index is the geometric mean of the singular values of the stacked regressor H over sqrt(m), m sampled poses. H of
a parallel robot has directions in the parameter space that no motion excites; their singular value is zero and the
paper's product with them. The choice made here: all candidates are judged on the *same* subspace, the one that the
regressors of all of them together excite. Its dimension is the paper's zeta. H is not scaled by columns, as in the
paper, and like there only the dynamic parameters count, not the gains of the joint controller.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.motion import SAMPLES_PER_HARMONIC
from identify.progress import Advance
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory, TravelLimitedRobot, check_travel, random_trajectory

NULL_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest belong to directions that no candidate excites."""

ATTEMPTS = 50
"""Random trajectories tried, on the average, for each one that has to be admissible."""

Check = Callable[[FourierTrajectory, Array], object]
"""Raises TrajectoryError for a trajectory that is not admissible at some instants (N,) [s]."""


class RegressorRobot(TravelLimitedRobot, Protocol):
    """What the choice among random trajectories needs to know of a robot."""

    @property
    def home_pose(self) -> Any:
        """Pose (6,) [m, rad] at which every trajectory starts."""
        ...

    def twist(self, pose: Any, pose_rate: Any) -> Any:
        """Twists (N, 6) [m/s, rad/s] from poses and pose rates (N, 6)."""
        ...

    def twist_dot(self, pose: Any, pose_rate: Any, pose_acceleration: Any) -> Any:
        """Time derivatives of the twists (N, 6), eq. 38."""
        ...

    def regressor(self, pose: Any, twist: Any, twist_dot: Any) -> Any:
        """Regressors (N, 6, p) of the inverse dynamics."""
        ...


def observability_indices(
    robot: RegressorRobot,
    trajectories: list[FourierTrajectory],
    duration_s: float,
    advance: Advance = lambda n=1: None,
) -> Array:
    """Observability index (eq. 39) of each trajectory, on the subspace that all of them together excite."""
    factors, samples = [], 0
    for trajectory in trajectories:
        stacked = stacked_regressor(robot, trajectory, duration_s)
        samples = stacked.shape[0] // 6
        factors.append(np.linalg.qr(stacked, mode="r"))
        advance()
    excited = _row_space(np.concatenate(factors))
    return np.array([_geometric_mean(factor @ excited) for factor in factors]) / np.sqrt(samples)


def stacked_regressor(robot: RegressorRobot, trajectory: FourierTrajectory, duration_s: float) -> Array:
    """Regressors of all sampled poses stacked, (6 m, p); H of eq. 26."""
    rate_hz = SAMPLES_PER_HARMONIC * trajectory.harmonics * trajectory.fundamental_hz
    t = np.arange(max(2, round(duration_s * rate_hz))) / rate_hz
    pose, rate, acceleration = trajectory.pose(t), trajectory.pose_rate(t), trajectory.pose_acceleration(t)
    regressor = robot.regressor(pose, robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration))
    return np.asarray(regressor, dtype=float).reshape(6 * len(t), -1)


def admissible_trajectories(
    robot: RegressorRobot,
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


def _row_space(matrix: Array) -> Array:
    _, singular, rows = np.linalg.svd(matrix, full_matrices=False)
    return rows[singular > NULL_TOLERANCE * singular[0]].T


def _geometric_mean(matrix: Array) -> float:
    singular = np.linalg.svd(matrix, compute_uv=False)
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(singular))))
