"""How many independent groups of dynamic parameters a trajectory excites (section 4.2: QR of the regression matrix)."""

import numpy as np
from scipy.linalg import qr

from dynamics import Robot
from dynamics.closed_loop import Reference
from identify.arrays import Array
from identify.filtering import spline_derivatives
from identify.loop_parameters import starting_guess
from identify.scenario import Scenario


def base_rank(robot: Robot, reference: Reference, scenario: Scenario) -> int:
    """Rank of the regression matrix H (eq. 26) of the reference motion by pivoted QR.

    Columns are scaled by the parameters' sizes, so that they compare as torques; diagonal entries of R below
    `qr_threshold` of the largest count as zero. The paper compares unscaled entries with the same number.
    """
    guess = starting_guess(robot, scenario.model.start_parameters, 1.0)
    matrix = reference_regressor(robot, reference, scenario.timing.frame_rate_hz) * guess.std[:64]
    diagonal = np.abs(np.diag(qr(matrix, mode="r", pivoting=True)[0]))
    return int(np.sum(diagonal > scenario.identification.qr_threshold * diagonal[0]))


def reference_regressor(robot: Robot, reference: Reference, rate_hz: float) -> Array:
    """Joint-torque regressor (6 n, 64) along the reference motion, N m per unit parameter."""
    acceleration, _ = spline_derivatives(reference.rates, rate_hz)
    twist = robot.twist(reference.poses, reference.rates)
    twist_dot = robot.twist_dot(reference.poses, reference.rates, acceleration)
    regressor = robot.regressor(reference.poses, twist, twist_dot)
    torque_map = np.linalg.inv(robot.joint_jacobian(reference.poses)).transpose(0, 2, 1)
    return np.asarray((torque_map @ regressor).reshape(-1, regressor.shape[2]), dtype=float)
