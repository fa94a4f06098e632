"""Limits of the motion of a robot: travel, reach, and its two kinds of singularity.

- Travel is the magnitude of each joint coordinate, which has a limit.
- Reach is the reach margin of a leg. For a crank, it is sin^2 of the angle between the crank and
  the direction to the platform joint in the plane of the crank. At 0, the leg is stretched or
  folded.
- On the actuator side (J_a1), the measure is the leverage of an actuator on its leg, in 0..1. For a
  crank w with the axis s and the link l, it is |(w x l) . s| / (|w| |l|). If it is zero, the
  actuator does not move the platform. For a crank, it is zero if the reach margin is zero.
- On the platform side (J_a2), the measure is the condition number of J_a2 for the motions that the
  platform can make. A row of J_a2 has the unit vector along the force of a leg, and its moment
  about the platform origin, divided by the characteristic length. All entries thus have no unit. If
  the condition number is infinite, the platform can move although all actuators are locked.

The characteristic length is the RMS distance of the platform joints from the platform origin (0.2 m
for rss6). `rigid_body.jacobians.singularity_measures` has the measures as CasADi expressions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import check_type, floats, real, row_text, rows
from dynamics.errors import (
    DynamicsError,
    ShapeError,
    SingularPoseError,
    TravelError,
    UnreachablePoseError,
)
from dynamics.kinematics import forward_kinematics
from dynamics.robot import Robot

LEAST_LEVERAGE = 0.05
"""Smallest leverage for `check_motion`.

Below it, the force along the leg is more than 20 times the force of the actuator. rss6 is above
0.09 within its travel.
"""

# Largest condition number for `check_motion`. Within the travel of rss6, it is below 5 for J_a2,
# and below 10 for J_ad.
MOST_CONDITION = 20.0


@dataclass(frozen=True)
class WorkspaceMeasures:
    """Measures of N poses. All except the reach margins are NaN if a leg cannot reach the pose.

    `theta` (N, n) is in rad or m. `reach_margin` (N, n) is negative out of reach. `leverage` (N, n)
    is from J_a1. `platform_rows` (N, n, n) is the scaled J_a2. `travel_limit` is in rad or m.
    """

    theta: np.ndarray
    reach_margin: np.ndarray
    leverage: np.ndarray
    platform_rows: np.ndarray
    travel_limit: float

    @cached_property
    def platform_condition(self) -> np.ndarray:
        """Condition number of J_a2 (N,)."""
        return self._condition(self.platform_rows)

    @cached_property
    def joint_condition(self) -> np.ndarray:
        """Condition number of J_ad = J_a1^-1 J_a2 (N,)."""
        return self._condition(self.platform_rows / self.leverage[..., None])

    def _condition(self, matrices: np.ndarray) -> np.ndarray:
        """Condition numbers of matrices, NaN out of reach."""
        result = np.full(len(matrices), np.nan)
        # NumPy raises an error for matrices with NaN
        result[self.reachable] = np.linalg.cond(matrices[self.reachable])
        return result

    @property
    def reachable(self) -> np.ndarray:
        """True for each pose (N,) that all legs reach."""
        return np.asarray((self.reach_margin > 0).all(axis=1))

    @property
    def travel_share(self) -> np.ndarray:
        """Ratio (N,) of the largest joint coordinate, in magnitude, to the travel limit."""
        return np.asarray(np.abs(self.theta).max(axis=1) / self.travel_limit)


@dataclass(frozen=True)
class Extreme:
    """Point of a motion that is nearest to a limit.

    `row` is the index of the pose. `time` is in s, and NaN if no times are given. `leg` is 1 to n,
    and None if the value belongs to no single leg.
    """

    value: float
    limit: float
    row: int
    time: float
    leg: int | None


@dataclass(frozen=True)
class MotionExtremes:
    """Points of a motion that are nearest to the limits.

    The limits are those of the reach margin, of the travel |theta| (rad or m), of the leverage
    (J_a1), and of the condition number of the scaled J_a2.
    """

    reach: Extreme
    travel: Extreme
    leverage: Extreme
    condition: Extreme


def measure(robot: Robot, pose: ArrayLike) -> WorkspaceMeasures:
    """Measures of poses (N, 6), or of one pose (6,) as N = 1.

    Raises ShapeError, ChartError, or DynamicsError if `robot` is not a Robot.
    """
    check_type("robot", robot, Robot, DynamicsError)
    poses = np.atleast_2d(robot.charted(pose))
    theta, margin = (part[..., 0] for part in robot.functions["inverse_kinematics"](poses))
    leverage, platform_rows = robot.functions["singularity_measures"](poses)
    # a margin is NaN if squares have overflowed
    margin[np.isnan(margin)] = -np.inf
    unreachable = ~(margin > 0).all(axis=1)
    for values in (theta, leverage, platform_rows):
        values[unreachable] = np.nan
    return WorkspaceMeasures(theta, margin, leverage[..., 0], platform_rows, robot.travel_limit)


def measure_travel(
    robot: Robot, samples: int, travel_limit: float | None = None
) -> WorkspaceMeasures:
    """Measures of poses for random joint coordinates within the travel limit.

    The travel limit is that of the robot, unless another one is given. The search for each pose
    begins at home. Joint coordinates without a pose are omitted, so that there can be fewer rows
    than samples.
    """
    limit = robot.travel_limit if travel_limit is None else travel_limit
    # the seed is fixed, because a report of a robot must not change from run to run
    joints = np.random.default_rng(0).uniform(-limit, limit, (samples, robot.layout.joints))
    start = np.tile(robot.home_pose, (samples, 1))
    solution = forward_kinematics.search(robot.functions, robot.geometry.chart, joints, start)
    return replace(measure(robot, solution.pose[solution.converged]), travel_limit=limit)


def check_motion(
    robot: Robot,
    pose: ArrayLike,
    times: ArrayLike | None = None,
    *,
    travel_margin: float = 0.0,
    least_leverage: float = LEAST_LEVERAGE,
    most_condition: float = MOST_CONDITION,
) -> MotionExtremes:
    """Check a motion against all limits, and return its points nearest to them.

    The motion is poses (N, 6) at times (N,), s, with N >= 1. Each error states the time or row, the
    leg, the value and the limit. Raises UnreachablePoseError out of reach, and TravelError beyond
    the travel limit minus `travel_margin` (rad or m). Raises SingularPoseError for a leverage
    (J_a1) below `least_leverage`, or a condition number of the scaled J_a2 above `most_condition`.
    Raises ChartError for a pose that the platform cannot have. Raises ShapeError for a wrong shape,
    or for times that do not increase.
    """
    poses = np.atleast_2d(rows("pose", pose, 6))
    if not len(poses):
        raise ShapeError("a motion needs at least one pose, got none")
    instants = np.full(len(poses), np.nan) if times is None else _increasing(times, len(poses))
    travel_margin = real("travel_margin", travel_margin, TravelError, least=0)
    least_leverage = real("least_leverage", least_leverage, DynamicsError, least=0)
    most_condition = real("most_condition", most_condition, DynamicsError, least=1)
    measures = measure(robot, poses)

    def extreme(values: np.ndarray, limit: float, pick: Callable[..., np.intp]) -> Extreme:
        row, *leg = (int(index) for index in np.unravel_index(pick(values), values.shape))
        return Extreme(
            float(values[row, *leg]), limit, row, float(instants[row]), leg[0] + 1 if leg else None
        )

    def check(
        worst: Extreme,
        is_allowed: bool,
        kind: type[DynamicsError],
        quantity: str,
        relation: str,
        note: str = "",
    ) -> None:
        if not is_allowed:
            when = f"row {worst.row}" if np.isnan(worst.time) else f"t = {worst.time:.4g} s"
            who = f" of leg {worst.leg}" if worst.leg else ""
            raise kind(
                f"{quantity}{who} of {robot.name} is {worst.value:.4g} at {when}, "
                f"{relation}{worst.limit:.4g} (pose {row_text(poses[worst.row], 4)}{note})"
            )

    reach = extreme(measures.reach_margin, 0.0, np.argmin)
    check(
        reach,
        reach.value > 0,
        UnreachablePoseError,
        "reach margin",
        "must be > ",
        "; the margin has no unit, and below 0 the leg does not reach the pose",
    )
    travel = extreme(np.abs(measures.theta), robot.travel_limit - travel_margin, np.argmax)
    check(
        travel,
        travel.value <= travel.limit,
        TravelError,
        f"|theta| in {robot.layout.joint_unit}",
        "limit ",
    )
    leverage = extreme(measures.leverage, least_leverage, np.argmin)
    check(
        leverage,
        leverage.value >= leverage.limit,
        SingularPoseError,
        "leverage (J_a1)",
        "must be >= ",
    )
    condition = extreme(measures.platform_condition, most_condition, np.argmax)
    check(
        condition,
        condition.value <= condition.limit,
        SingularPoseError,
        "condition of J_a2",
        "limit ",
    )
    return MotionExtremes(reach, travel, leverage, condition)


def _increasing(times: ArrayLike, count: int) -> np.ndarray:
    """Times (count,) that increase. Raises ShapeError otherwise."""
    values = floats("times", times, (count,))
    back = np.flatnonzero(np.diff(values) <= 0)
    if len(back):
        row = int(back[0]) + 1
        raise ShapeError(
            f"times must increase, but times[{row}] = {values[row]} s follows {values[row - 1]} s"
        )
    return values
