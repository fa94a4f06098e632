"""How many independent groups of dynamic parameters a trajectory excites (section 4.2: QR of the regression matrix)."""

import numpy as np
from scipy.linalg import qr

from dynamics import Robot
from dynamics.closed_loop import Reference
from identify.arrays import Array
from identify.filtering import spline_derivatives


def base_rank(robot: Robot, reference: Reference, rate_hz: float, threshold: float) -> int:
    """Number of diagonal entries of R above `threshold` in the pivoted QR of H (eq. 26) along a reference motion.

    As in the paper, H stacks the wrenches (N and N m per unit of each parameter) and is not scaled.
    """
    diagonal = np.diag(qr(reference_regressor(robot, reference, rate_hz), mode="r", pivoting=True)[0])
    return int(np.sum(np.abs(diagonal) > threshold))


def reference_regressor(robot: Robot, reference: Reference, rate_hz: float) -> Array:
    """Regression matrix H (6 n, 64) of a reference motion sampled at `rate_hz`."""
    acceleration, _ = spline_derivatives(reference.rates, rate_hz)
    twist = robot.twist(reference.poses, reference.rates)
    twist_dot = robot.twist_dot(reference.poses, reference.rates, acceleration)
    regressor = robot.regressor(reference.poses, twist, twist_dot)
    return np.asarray(regressor.reshape(-1, regressor.shape[2]), dtype=float)
