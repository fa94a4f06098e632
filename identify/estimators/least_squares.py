"""Inverse dynamics by least squares, from measured torques and either poses or encoders.

With tau the filtered torque of a slipping joint, at every instant (eq. 17 and 25; eq. 31)

    (J_ad^-T Gamma(chi, v, v_dot) Xi)_j = tau_j
    lp (U - theta)_j + li integral(U - theta)_j + ld (U_dot - theta_dot)_j + z_j = tau_j

The symbols are those of `warm_start`. Both equations form one system with the unknowns Xi, the
gains and the torques z (n,) at the start. The measured torque determines the scale, so no anchor is
needed. Parameters that the motion does not excite keep the initial guess with its standard
deviations.

Noise of the poses enters the regression matrix through both derivatives, and biases the estimates
towards zero, for any number of samples. The weights of the rows follow from the residuals of each
joint (Gautier, "Dynamic identification of robots with power model", ICRA 1997).
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
from identify.estimation.bounds import least_values
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.prior import FIXED, StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.estimation.warm_start import REWEIGHTINGS, bounded_fit, joint_balance
from identify.estimators.estimator import Estimate, Evidence, estimator
from identify.filtering import zero_phase_filter
from identify.model.loop_model import LoopModel

# Prior standard deviation of the torques at the start, N m. It is so large that it has no effect.
UNKNOWN_TORQUE = 1e3
# The same for the forces, N, of joints that slide.
UNKNOWN_FORCE = 1e6


@dataclass(frozen=True)
class TorqueEquations:
    """Linear equations matrix @ unknowns = right, in N m or N.

    The first m rows are equations of the dynamics, and the other m rows of the controller.

    layout                          Layout of the parameters, the first of the u unknowns. The
                                    torques of the joints at the start follow.
    matrix, right (2 m, u) and (2 m,)
                                    Coefficients and right-hand side.
    kind (2 m,)                     Index of the joint. In rows of the controller, the number of
                                    joints is added to the index.
    correlation                     Number of samples that count as one independent sample. After a
                                    low-pass filter with cutoff f there are 2 f independent samples
                                    per second.
    slipping (N, joints)            True for the frames and joints of the rows.
    """

    layout: ParameterLayout
    matrix: Array
    right: Array
    kind: NDArray[np.intp]
    correlation: float
    slipping: NDArray[np.bool_]

    def residual(self, unknowns: Array) -> Array:
        """Return the residual torques (2 m,) of the equations."""
        return np.asarray(self.matrix @ unknowns - self.right, dtype=float)

    def whitened(self, noise: Array) -> "TorqueEquations":
        """Return the equations with rows divided by their standard deviations (2 m,)."""
        return replace(self, matrix=self.matrix / noise[:, None], right=self.right / noise)


def torque_equations(
    problem: OutputErrorProblem,
    run: LoopModel,
    poses: Array,
    torque: Array,
    slipping: NDArray[np.bool_] | None = None,
) -> TorqueEquations:
    """Return the equations of a run for some poses (N, 6) and joint torques (N, n), N m or N.

    The commands are those that were logged. problem: provides the filter, and the gains of a
    cascade about which its torque is linearised. slipping (N, n): frames and joints of the rows, by
    default all frames in which a joint slips.
    """
    low_pass = problem.low_pass
    rate_hz = run.settings.timing.frame_rate_hz
    layout = run.robot.layout
    law = run.settings.drives.joint_law(layout.split(problem.guess.values)[3])
    balance, slips = joint_balance(run, poses, low_pass, law)
    rows = slips if slipping is None else slipping
    columns = balance[rows]
    filtered = zero_phase_filter(torque, rate_hz, low_pass.cutoff_hz, low_pass.order)[rows]
    dynamic = layout.dynamic
    after_dynamic = slice(layout.dynamic.stop, None)
    matrix = np.zeros((2 * len(columns), columns.shape[1]))
    matrix[: len(columns), dynamic] = columns[:, dynamic]
    # The balance has the controller's torque with the opposite sign.
    matrix[len(columns) :, after_dynamic] = -columns[:, after_dynamic]
    joint = np.nonzero(rows)[1]
    # The torque of a known payload is on the right-hand side.
    right_side = np.concatenate([filtered - columns[:, dynamic] @ run.payload[dynamic], filtered])
    correlation = max(1.0, rate_hz / (2 * low_pass.cutoff_hz))
    kind = np.concatenate([joint, joint + layout.joints])
    return TorqueEquations(layout, matrix, right_side, kind, correlation, rows)


def lower_bounds(layout: ParameterLayout) -> Array:
    """Return the lower bounds (u,) of the unknowns, -inf for the torques at the start."""
    return np.concatenate([least_values(layout), np.full(layout.joints, -np.inf)])


def prior_of(guess: StartingGuess) -> tuple[Array, Array]:
    """Return prior values (u,) and prior standard deviations (u,) of the unknowns."""
    joints = guess.layout.joints
    unknown = UNKNOWN_FORCE if guess.layout.prismatic else UNKNOWN_TORQUE
    return np.append(guess.values, np.zeros(joints)), np.append(guess.std, [unknown] * joints)


def nearest_admissible(
    layout: ParameterLayout, unknowns: Array, information: Array, scale: Array
) -> Array:
    """Return the unknowns (u,) within their bounds that are nearest to given unknowns.

    The metric is the information matrix (u, u). scale (u,): typical magnitudes of the unknowns,
    which improve the conditioning.
    """
    lower = lower_bounds(layout)
    if (unknowns >= lower).all():
        return unknowns
    # Least squares with the metric |factor x|^2.
    factor = np.linalg.cholesky(information * np.outer(scale, scale)).T
    solved = lsq_linear(
        factor, factor @ (unknowns / scale), bounds=(lower / scale, np.inf), method="bvls"
    )
    return np.maximum(solved.x * scale, lower)


SMALLEST_NOISE_N_M = 1e-9  # smallest standard deviation of a row, which avoids a division by zero


@estimator("torque, LS", uses="poses, torque")
def least_squares(evidence: Evidence) -> Estimate:
    """Estimate by ordinary least squares, with the same weight for all joints."""
    return _solved(evidence, time.perf_counter(), weighted=False)


@estimator("torque, weighted LS", uses="poses, torque")
def weighted_least_squares(evidence: Evidence) -> Estimate:
    """Estimate by least squares weighted by the residual of each joint."""
    return _solved(evidence, time.perf_counter(), weighted=True)


@estimator("torque, LS in two steps", uses="poses, torque")
def two_steps(evidence: Evidence) -> Estimate:
    """Estimate inertial parameters first, then friction and gains with the inertias found.

    Both steps are weighted least squares. The first step holds friction at the initial guess.
    Errors of this guess bias the inertias (the two-step procedure that Li et al., Electronics 8(8),
    836, 2019, section 1, quote for parallel robots). In each step, the held parameters count as
    exact, also in the standard deviations.
    """
    began = time.perf_counter()
    equations = measured_equations(evidence)
    guess = evidence.problem.guess
    friction = slice(guess.layout.inertial.stop, guess.layout.dynamic.stop)
    first, first_noise = fit_equations(equations, _held(guess, friction), weighted=True)
    count = len(guess.values)
    inertias = guess.layout.inertial
    values = guess.values.copy()
    values[inertias] = first[inertias]
    remaining = _held(replace(guess, values=values), inertias)
    second, noise = fit_equations(equations, remaining, weighted=True)
    seconds = time.perf_counter() - began
    std = _fit_std(equations, first_noise, _held(guess, friction))
    after = slice(inertias.stop, count)
    std[after] = _fit_std(equations, noise, remaining)[after]
    return Estimate(second[:count], std, seconds, 2 * REWEIGHTINGS)


def _held(guess: StartingGuess, held: slice) -> StartingGuess:
    """Return the guess with some parameters held at their values."""
    std = guess.std.copy()
    std[held] *= FIXED
    return replace(guess, std=std)


@estimator("encoders, weighted LS", uses="encoders, torque")
def encoder_route(evidence: Evidence) -> Estimate:
    """Estimate by weighted least squares on poses from encoders and forward kinematics.

    This is the conventional method without a camera. Forward kinematics of a parallel robot has no
    closed form. Newton's method solves all instants at once, each from its desired pose, which is
    always near the true pose. The note states the time for this. Raises EstimationError if there is
    no pose for the angles near the desired pose, or if the record has no joint channels.
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

    began: beginning of the estimation, from `time.perf_counter`.
    """
    equations = measured_equations(evidence, poses)
    guess = evidence.problem.guess
    unknowns, noise = fit_equations(equations, guess, weighted)
    seconds = time.perf_counter() - began
    std = _fit_std(equations, noise, guess)
    return Estimate(unknowns[: len(std)], std, seconds, REWEIGHTINGS)


def _fit_std(equations: TorqueEquations, noise: Array, guess: StartingGuess) -> Array:
    """Return the standard deviations (p,) of parameters fitted to rows with some noise (2 m,)."""
    scale = prior_of(guess)[1]
    # In units of the prior standard deviations, held parameters do not make the inverse inaccurate.
    known = information(equations.whitened(noise), guess) * np.outer(scale, scale)
    covariance = np.linalg.inv(known) * np.outer(scale, scale)
    return standard_deviations(covariance, len(guess.values))


def measured_equations(evidence: Evidence, poses: Array | None = None) -> TorqueEquations:
    """Return the equations of the measured torque and poses, or of other poses (N, 6).

    Raises EstimationError if the record has no torque.
    """
    run = evidence.run
    torque = evidence.joint_channels().torque
    poses = run.without_gaps() if poses is None else poses
    return torque_equations(evidence.problem, run, poses, torque)


def fit_equations(
    equations: TorqueEquations, guess: StartingGuess, weighted: bool
) -> tuple[Array, Array]:
    """Return the unknowns (u,) of the equations, and the standard deviations (2 m,) of the rows.

    The standard deviations, N m or N, come from the residuals of each joint, if weighted, or else
    of all joints together. Rows of the dynamics and of the controller are kept apart. The standard
    deviations account for the correlation due to the filter.
    """
    # Without weights there are only two groups, the rows of dynamics and of controllers.
    groups = equations.kind if weighted else equations.kind // equations.layout.joints
    # First value, N m or N. It only affects the weight of the initial guess.
    noise = np.full(len(equations.right), 0.1)
    for _ in range(REWEIGHTINGS):
        rows = equations.whitened(noise)
        unknowns = bounded_fit(
            rows.matrix, rows.right, guess, ScaleAnchor("prior"), lower_bounds(guess.layout)
        )
        noise = row_noise(equations, unknowns, groups)
    return unknowns, noise


def row_noise(equations: TorqueEquations, unknowns: Array, groups: NDArray[np.intp]) -> Array:
    """Return standard deviations (2 m,) with which rows can be treated as independent.

    They are the RMS residual of the rows of each group, times the square root of `correlation`.
    groups (2 m,): index of the group of each row.
    """
    squares = equations.residual(unknowns) ** 2
    rms = np.sqrt(np.bincount(groups, squares) / np.maximum(np.bincount(groups), 1))
    return np.maximum(rms, SMALLEST_NOISE_N_M)[groups] * np.sqrt(equations.correlation)


def information(rows: TorqueEquations, guess: StartingGuess) -> Array:
    """Return the information (u, u) of whitened rows and the initial guess."""
    _, std = prior_of(guess)
    return np.asarray(rows.matrix.T @ rows.matrix + np.diag(1 / std**2), dtype=float)


def standard_deviations(covariance: Array, count: int) -> Array:
    """Return the standard deviations (p,) of the first `count` unknowns of a covariance (u, u)."""
    return np.asarray(np.sqrt(np.diag(covariance))[:count], dtype=float)
