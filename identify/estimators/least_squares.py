"""Inverse dynamics by least squares, from measured torques and either poses or encoders.

With tau the filtered torque of a slipping joint, at every instant (eq. 17 and 25; eq. 31)

    (J_ad^-T Gamma(chi, v, v_dot) Xi)_j = tau_j
    lp (U - theta)_j + li integral(U - theta)_j + ld (U_dot - theta_dot)_j + z_j = tau_j

Both stand in one system with the unknowns Xi, lp, li, ld and the starting torques z (n,). The
measured torque gives the scale, so that no anchor is needed. What the motion does not show is left
to the starting guess with its standard deviations.

Noise in the poses gets into the regression matrix through both derivatives, and draws the estimates
towards zero. No number of samples removes that bias. The weights of the rows follow from what each
joint leaves unexplained (Gautier, "Dynamic identification of robots with power model", ICRA 1997).
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dynamics import DynamicsError
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.prior import ScaleAnchor, StartingGuess
from identify.estimation.warm_start import REWEIGHTINGS, bounded_fit, joint_balance
from identify.estimators.estimator import Estimate, Evidence, estimator
from identify.filtering import zero_phase_filter
from identify.model.loop_model import LoopModel

FREE_TORQUE = {False: 1e3, True: 1e6}
"""Standard deviation of a starting torque, N m, or of a force of prismatic joints (True), N.

It is so large that before the experiment nothing is known of it.
"""


@dataclass(frozen=True)
class TorqueEquations:
    """Linear equations matrix @ unknowns = right, in N m or N.

    The first n rows are those of the dynamics, and the others those of the controller.

    Attributes
    ----------
    layout : ParameterLayout
        Layout of the parameters, which are the first of the u unknowns. The starting torques of the
        joints come after them.
    matrix, right : ndarray, shapes (2 n, u) and (2 n,)
        Coefficients and right side.
    kind : ndarray of int, shape (2 n,)
        Number of the joint in rows of its dynamics. In rows of its controller the number of joints
        is added.
    correlation : float
        Number of samples for each independent one. A low-pass filter of cutoff f leaves 2 f
        of these a second.
    slipping : ndarray of bool, shape (N, joints)
        Frames and joints that the rows are of.
    """

    layout: ParameterLayout
    matrix: Array
    right: Array
    kind: NDArray[np.intp]
    correlation: float
    slipping: NDArray[np.bool_]

    def residual(self, unknowns: Array) -> Array:
        """Return the torques (2 n,) that the equations leave unexplained."""
        return np.asarray(self.matrix @ unknowns - self.right, dtype=float)

    def whitened(self, noise: Array) -> "TorqueEquations":
        """Return the equations with rows divided by their standard deviations (2 n,)."""
        return replace(self, matrix=self.matrix / noise[:, None], right=self.right / noise)


def torque_equations(
    problem: OutputErrorProblem,
    run: LoopModel,
    poses: Array,
    torque: Array,
    slipping: NDArray[np.bool_] | None = None,
) -> TorqueEquations:
    """Return the equations of poses (N, 6) and torques (N, n) of a run with its logged commands.

    The torques are in N m or N. problem: filter, and gains of a cascade about which its torque is
    linear. slipping (N, n): frames and joints of the rows. The default is those at which a joint
    slips.
    """
    low_pass = problem.low_pass
    rate_hz = run.settings.timing.frame_rate_hz
    layout = run.robot.layout
    law = run.settings.drives.joint_law(problem.guess.values[layout.joint_pid])
    balance, found = joint_balance(run, poses, low_pass, law)
    rows = found if slipping is None else slipping
    columns = balance[rows]
    felt = zero_phase_filter(torque, rate_hz, low_pass.cutoff_hz, low_pass.order)[rows]
    dynamic = layout.dynamic
    others = slice(layout.dynamic.stop, None)
    matrix = np.zeros((2 * len(columns), columns.shape[1]))
    matrix[: len(columns), dynamic] = columns[:, dynamic]
    # the balance holds the controller's torque with the opposite sign
    matrix[len(columns) :, others] = -columns[:, others]
    joint = np.nonzero(rows)[1]
    # the torque of a known payload stands on the right side
    right = np.concatenate([felt - columns[:, dynamic] @ run.payload[dynamic], felt])
    correlation = max(1.0, rate_hz / (2 * low_pass.cutoff_hz))
    kind = np.concatenate([joint, joint + layout.joints])
    return TorqueEquations(layout, matrix, right, kind, correlation, rows)


def lower_bounds(layout: ParameterLayout) -> Array:
    """Return lower bounds (u,): zero for parameters and gains, none for starting torques."""
    return np.concatenate([np.zeros(len(layout.names)), np.full(layout.joints, -np.inf)])


def prior_of(guess: StartingGuess) -> tuple[Array, Array]:
    """Return values (u,) and standard deviations (u,) of the unknowns before the experiment."""
    joints = guess.layout.joints
    free = FREE_TORQUE[guess.layout.prismatic]
    return np.append(guess.values, np.zeros(joints)), np.append(guess.std, np.full(joints, free))


def nearest_admissible(
    layout: ParameterLayout, unknowns: Array, information: Array, scale: Array
) -> Array:
    """Return the unknowns (u,) within their bounds that are nearest to given ones.

    The metric is that of the information matrix (u, u). scale (u,): sizes of the unknowns.
    """
    lower = lower_bounds(layout)
    if (unknowns >= lower).all():
        return unknowns
    # least squares with |factor x|^2 as the metric
    factor = np.linalg.cholesky(information * np.outer(scale, scale)).T
    solved = lsq_linear(
        factor, factor @ (unknowns / scale), bounds=(lower / scale, np.inf), method="bvls"
    )
    return np.maximum(solved.x * scale, lower)


SMALLEST_NOISE_N_M = 1e-9
"""Least standard deviation of a row, by which residuals of zero can be divided."""


@estimator("torque, LS", uses="poses, torque")
def least_squares(evidence: Evidence) -> Estimate:
    """Estimate by ordinary least squares, in which all joints count alike."""
    return _solved(evidence, time.perf_counter(), weighted=False)


@estimator("torque, weighted LS", uses="poses, torque")
def weighted_least_squares(evidence: Evidence) -> Estimate:
    """Estimate by least squares weighted by the residual of each joint."""
    return _solved(evidence, time.perf_counter(), weighted=True)


@estimator("encoders, weighted LS", uses="encoders, torque")
def encoder_route(evidence: Evidence) -> Estimate:
    """Estimate by weighted least squares on poses from encoders and forward kinematics.

    This is the conventional route, which knows nothing of the camera. Forward kinematics of a
    parallel robot has no closed form. Newton's method solves all instants at once, each from the
    desired pose there, which the robot is never far from. The note says how long that took. Raises
    EstimationError if the angles belong to no pose near the desired one.
    """
    began = time.perf_counter()
    run = evidence.run
    try:
        poses = run.robot.forward_kinematics(evidence.joint_channels().angle, run.reference.poses)
    except DynamicsError as error:
        raise EstimationError(f"the encoders' angles give no poses: {error}") from None
    note = f"forward kinematics of {len(poses)} frames: {time.perf_counter() - began:.3f} s"
    return replace(_solved(evidence, began, weighted=True, poses=poses), note=note)


def _solved(
    evidence: Evidence, began: float, weighted: bool, poses: Array | None = None
) -> Estimate:
    """Return the estimate of a fit to the measured poses, or to others (N, 6).

    began: time, from `time.perf_counter`, at which the estimation began.
    """
    equations = measured_equations(evidence, poses)
    guess = evidence.problem.guess
    unknowns, noise = fit_equations(equations, guess, weighted)
    seconds = time.perf_counter() - began
    covariance = np.asarray(
        np.linalg.inv(information(equations.whitened(noise), guess)), dtype=float
    )
    count = len(guess.values)
    return Estimate(unknowns[:count], standard_deviations(covariance, count), seconds, REWEIGHTINGS)


def measured_equations(evidence: Evidence, poses: Array | None = None) -> TorqueEquations:
    """Return the equations of the measured torque and poses, or of other poses (N, 6).

    Raises EstimationError if the record has no torque.
    """
    run = evidence.run
    torque = evidence.joint_channels().torque
    moved = run.without_gaps() if poses is None else poses
    return torque_equations(evidence.problem, run, moved, torque)


def fit_equations(
    equations: TorqueEquations, guess: StartingGuess, weighted: bool
) -> tuple[Array, Array]:
    """Return the unknowns (u,) of the equations, and the standard deviations (2 n,) of the rows.

    The standard deviations, N m or N, come from the residuals of each joint, if weighted, or else
    of all joints. They account for the correlation by the filter.
    """
    # without weights joints count alike, but dynamics and controller have residuals of their own
    groups = equations.kind if weighted else equations.kind // equations.layout.joints
    # N m or N: a first value, which weighs the starting guess only
    noise = np.full(len(equations.right), 0.1)
    for _ in range(REWEIGHTINGS):
        rows = equations.whitened(noise)
        unknowns = bounded_fit(
            rows.matrix, rows.right, guess, ScaleAnchor("prior"), lower_bounds(guess.layout)
        )
        noise = row_noise(equations, unknowns, groups)
    return unknowns, noise


def row_noise(equations: TorqueEquations, unknowns: Array, groups: NDArray[np.intp]) -> Array:
    """Return standard deviations (2 n,) with which rows may be taken as independent.

    They are the RMS residual of each row's group, times the root of the samples' correlation.
    """
    squares = equations.residual(unknowns) ** 2
    rms = np.sqrt(np.bincount(groups, squares) / np.maximum(np.bincount(groups), 1))
    return np.maximum(rms, SMALLEST_NOISE_N_M)[groups] * np.sqrt(equations.correlation)


def information(rows: TorqueEquations, guess: StartingGuess) -> Array:
    """Return the information (u, u) of whitened rows and the starting guess."""
    _, std = prior_of(guess)
    return np.asarray(rows.matrix.T @ rows.matrix + np.diag(1 / std**2), dtype=float)


def standard_deviations(covariance: Array, count: int) -> Array:
    """Return the standard deviations (p,) of the first `count` unknowns of a covariance (u, u)."""
    return np.asarray(np.sqrt(np.diag(covariance))[:count], dtype=float)
