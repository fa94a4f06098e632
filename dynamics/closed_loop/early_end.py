"""Errors of runs that end early, with what the kernels found to be the reason."""

from typing import Any

import numpy as np

from dynamics.closed_loop.motion_kernels import (
    LEFT_REACH,
    MEASURED_OUT_OF_REACH,
    SINGULAR_MASS,
    TOO_MANY_EVENTS,
)
from dynamics.closed_loop.problem import LoopProblem
from dynamics.closed_loop.run import LoopFailure, saturated_frames

UNSTABLE = " (the loop is unstable)"

FAILURES = {
    LEFT_REACH: f"the robot left the reachable set{UNSTABLE}:",
    SINGULAR_MASS: "the mass matrix is not positive definite: masses or inertias are zero or "
    "overflow",
    TOO_MANY_EVENTS: "more stick-slip events than a frame can hold",
    MEASURED_OUT_OF_REACH: "the measured pose is out of reach, so that the servo has no command; "
    "there",
}


def failure(problem: LoopProblem, status: int, frame: int, now: Any, record: Any) -> LoopFailure:
    """Error of a run that ended early, with the leg that is to blame for a pose out of reach."""
    why = FAILURES[status]
    if status in (LEFT_REACH, MEASURED_OUT_OF_REACH):
        last = now.known.inputs[: problem.sizes.coordinates]
        at = problem.robot.pose(last if status == LEFT_REACH else record.measured[frame])
        margin = problem.robot.reach_margin(at)
        leg = int(np.argmin(margin))
        why += f" leg {leg + 1} has the least reach margin, {margin[leg]:.3g}, must be > 0"
    return stopped(problem, frame, record, why)


def stopped(problem: LoopProblem, frame: int, record: Any, why: str) -> LoopFailure:
    """Error of a run that ended early, with the frames at which actuators were at their limit."""
    limit = problem.settings.drives.torque_limit
    unit = problem.robot.layout.unit("joint1.coulomb")
    saturated = saturated_frames(record.torque[:frame], limit)
    when = f"t = {frame * problem.period:.3f} s"
    # weak actuators make a robot leave the reach of a loop that is stable
    if saturated:
        why = why.replace(UNSTABLE, "")
        when += f", saturated in {saturated} of {frame} frames, limit {limit:g} {unit}"
    return LoopFailure(f"closed loop stopped at frame {frame} ({when}): {why}", frame, saturated)
