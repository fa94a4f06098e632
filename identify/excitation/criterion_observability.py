"""The paper's observability index (eq. 39) as a function of the unknowns of a trajectory, with exact derivatives.

The index is the geometric mean of the singular values of H over sqrt(m). Of the 64 columns of H only those of the base
parameters are independent: H = H_1 C with H_1 the pivot columns and C the base combinations (rank, 64), so the product
of the singular values that are not zero is sqrt(det(H_1^T H_1) det(C C^T)), whichever pivots were chosen:

    ln O_in = (ln det(H_1^T H_1) + ln det(C C^T)) / (2 rank) - ln(m) / 2.

H_1 is first divided by the triangular factor R of one trajectory, which takes out the units of the parameters and
keeps H_1^T H_1 well conditioned. One period is sampled: over whole periods the index does not depend on their number.
"""

import casadi as ca
import numpy as np
from scipy.linalg import qr, solve_triangular

from dynamics import Robot
from identify.estimation.base_parameters import base_parameters, structural_regressor
from identify.excitation.log_determinant import log_determinant
from identify.excitation.motion import motion, sample_times, wrench_regressor
from identify.excitation.unknowns import Unknowns

SMOOTHING_RAD_S = 0.02
"""v_s in tanh(theta_dot / v_s) where derivatives are asked for: as much as a velocity changes between two samples."""


def log_observability(
    robot: Robot, unknowns: Unknowns, typical: np.ndarray, smoothing_rad_s: float | None = None
) -> ca.Function:
    """z -> ln O_in (eq. 39). `typical` is the z of a trajectory that excites everything; it only sets the scale.

    `smoothing_rad_s` smooths the sign of Coulomb friction, which makes the function differentiable.
    """
    base = base_parameters(structural_regressor(robot))
    times = sample_times(unknowns.fundamental_hz, unknowns.harmonics)
    z = ca.MX.sym("z", unknowns.size)
    sampled = wrench_regressor(robot, smoothing_rad_s).map(len(times))(*motion(unknowns, z, times))
    columns = ca.Function("pivots", [z], [sampled[list(base.pivots), :]])
    factor = qr(np.array(columns(typical)).T, mode="r")[0][: base.rank]
    inverse = solve_triangular(factor, np.eye(base.rank))
    scaled = ca.DM(inverse.T) @ columns(z)
    constant = 2 * np.log(np.abs(np.diag(factor))).sum()
    constant += np.linalg.slogdet(base.combinations @ base.combinations.T)[1]
    determinant = log_determinant(base.rank)(scaled @ scaled.T)
    index = (determinant + constant) / (2 * base.rank) - np.log(len(times)) / 2
    return ca.Function("log_observability", [z], [index], ["z"], ["value"])
