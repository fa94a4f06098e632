"""Forward kinematics by Newton's method on the closed-form inverse kinematics."""

from typing import Protocol

import numpy as np

from dynamics.errors import ConvergenceError, UnreachablePoseError

# Newton stops at the first; where rounding keeps it from getting there, the second still counts as solved.
ANGLE_TOLERANCE = 1e-14
ROUNDING_TOLERANCE = 1e-12
MAX_ITERATIONS = 50


class InverseKinematics(Protocol):
    """What Newton's method needs of a robot."""

    def inverse_kinematics(self, pose: np.ndarray) -> np.ndarray:
        """Crank angles (6,) at a pose (6,); raises UnreachablePoseError."""
        ...

    def pose_jacobian(self, pose: np.ndarray) -> np.ndarray:
        """d(crank angles)/d(pose) (6, 6)."""
        ...


def solve(robot: InverseKinematics, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Pose (6,) or (N, 6) whose crank angles are theta, searched from start (6,) or (N, 6).

    Raises ConvergenceError with the residual left after the last iteration.
    """
    if theta.ndim == 1:
        return _newton(robot, theta, start)
    starts = np.broadcast_to(start, (len(theta), 6))
    return np.array([_newton(robot, row, first) for row, first in zip(theta, starts, strict=True)])


def _newton(robot: InverseKinematics, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
    pose = np.array(start, dtype=float)
    residual = theta - robot.inverse_kinematics(pose)
    for _ in range(MAX_ITERATIONS):
        if np.abs(residual).max() < ANGLE_TOLERANCE:
            return pose
        better = _damped(robot, theta, pose, _newton_step(robot, pose, residual), residual)
        if better is None:
            break
        pose, residual = better
    if np.abs(residual).max() < ROUNDING_TOLERANCE:
        return pose
    raise ConvergenceError(
        f"forward kinematics stopped at a residual of {np.abs(residual).max():.3g} rad, limit {ROUNDING_TOLERANCE:.0e} "
        f"rad, for crank angles {np.array2string(theta, precision=4)}"
    )


def _newton_step(robot: InverseKinematics, pose: np.ndarray, residual: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.solve(robot.pose_jacobian(pose), residual)
    except np.linalg.LinAlgError:
        raise ConvergenceError(
            f"forward kinematics met a singular pose {np.array2string(pose, precision=4)} with a residual of "
            f"{np.abs(residual).max():.3g} rad, limit {ROUNDING_TOLERANCE:.0e} rad"
        ) from None


def _damped(
    robot: InverseKinematics, theta: np.ndarray, pose: np.ndarray, step: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The first of the full step and its halves that stays in reach and lowers the residual; None if none does."""
    for halving in range(30):
        trial = pose + step / 2**halving
        try:
            error = theta - robot.inverse_kinematics(trial)
        except UnreachablePoseError:
            continue
        if np.linalg.norm(error) < np.linalg.norm(residual):
            return trial, error
    return None
