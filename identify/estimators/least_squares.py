"""Inverse dynamics by least squares: measured torque, ordinary and weighted; or joint coordinates
from encoders.

With tau the filtered torque of a slipping joint, at every instant (eq. 17 and 25; eq. 31)

    (J_ad^-T Gamma(chi, v, v_dot) Xi)_j = tau_j
    lp (U - theta)_j + li integral(U - theta)_j + ld (U_dot - theta_dot)_j + z_j = tau_j

Both stand in one system with the unknowns Xi, lp, li, ld and the starting torques z (n,). The
measured torque gives the scale: no anchor is needed. What the motion does not show is left to the
starting guess with its deviations.

Noise in the poses gets into the regression matrix through both derivatives, which draws the
estimates towards zero: no number of samples removes that bias. Weights, from what each joint leaves
unexplained: Gautier, "Dynamic identification of robots with power model", ICRA 1997.
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
from identify.estimation.prior import StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.estimation.warm_start import REWEIGHTINGS, bounded_fit, joint_balance
from identify.estimators.estimator import Estimate, Evidence, estimator
from identify.filtering import zero_phase_filter
from identify.model.loop_model import LoopModel
from identify.scenario import Scenario

FREE_TORQUE = {False: 1e3, True: 1e6}
"""Standard deviation of a starting torque [N m], or of a force [N] of prismatic joints, before the
experiment: nothing is known of it."""


@dataclass(frozen=True)
class TorqueEquations:
    """matrix (2 n, u) times the u unknowns = right (2 n,), N m or N: n rows of the dynamics, then
    the same of the controller.

    layout: of the parameters, the first unknowns; after them come the starting torques of the
    joints. kind (2 n,): number of the joint for its dynamics, and that after all joints for its
    controller; correlation: samples to one independent sample, because a low-pass filter of cutoff
    f leaves 2 f independent ones a second; slipping (N, joints): which rows stand here.
    """

    layout: ParameterLayout

    matrix: Array
    right: Array
    kind: NDArray[np.intp]
    correlation: float
    slipping: NDArray[np.bool_]

    def residual(self, unknowns: Array) -> Array:
        """Torques (2 n,) that the equations leave unexplained."""
        return np.asarray(self.matrix @ unknowns - self.right, dtype=float)

    def whitened(self, noise: Array) -> "TorqueEquations":
        """Rows divided by their standard deviations (2 n,)."""
        return replace(self, matrix=self.matrix / noise[:, None], right=self.right / noise)


def torque_equations(
    run: LoopModel,
    poses: Array,
    torque: Array,
    scenario: Scenario,
    slipping: NDArray[np.bool_] | None = None,
) -> TorqueEquations:
    """Equations of poses (N, 6) and torques (N, n) of a run with its logged commands; those of the
    joints that slip, or of the ones given (N, n)."""
    timing = scenario.timing
    filtering = scenario.filter
    layout = run.robot.layout
    guess = run.robot.parameter_sets[scenario.model.start_parameters]
    law = run.settings.drives.joint_law(guess.joint_pid)
    balance, found = joint_balance(run.robot, poses, run.logged, scenario, law, run.latencies)
    rows = found if slipping is None else slipping
    columns = balance[rows]
    smooth = zero_phase_filter(torque, timing.frame_rate_hz, filtering.cutoff_hz, filtering.order)[
        rows
    ]
    dynamic = layout.dynamic
    others = slice(layout.dynamic.stop, None)
    matrix = np.zeros((2 * len(columns), columns.shape[1]))
    matrix[: len(columns), dynamic] = columns[:, dynamic]
    matrix[len(columns) :, others] = -columns[:, others]
    joint = np.nonzero(rows)[1]
    right = np.concatenate([smooth - columns[:, dynamic] @ run.payload[dynamic], smooth])
    correlation = max(1.0, timing.frame_rate_hz / (2 * filtering.cutoff_hz))
    kind = np.concatenate([joint, joint + layout.joints])
    return TorqueEquations(layout, matrix, right, kind, correlation, rows)


def lower_bounds(layout: ParameterLayout) -> Array:
    """Bounds (u,): parameters and gains are not negative, starting torques are free."""
    return np.concatenate([np.zeros(len(layout.names)), np.full(layout.joints, -np.inf)])


def prior_of(guess: StartingGuess) -> tuple[Array, Array]:
    """Values (u,) and standard deviations (u,) of the unknowns before the experiment."""
    joints = guess.layout.joints
    free = FREE_TORQUE[guess.layout.prismatic]
    return np.append(guess.values, np.zeros(joints)), np.append(guess.std, np.full(joints, free))


def nearest_admissible(
    layout: ParameterLayout, unknowns: Array, information: Array, scale: Array
) -> Array:
    """Unknowns (u,) within their bounds that are nearest in the metric of the information matrix
    (u, u).
    """
    lower = lower_bounds(layout)
    if (unknowns >= lower).all():
        return unknowns
    factor = np.linalg.cholesky(information * np.outer(scale, scale)).T
    solved = lsq_linear(
        factor, factor @ (unknowns / scale), bounds=(lower / scale, np.inf), method="bvls"
    )
    return np.maximum(solved.x * scale, lower)


SMALLEST_NOISE_N_M = 1e-9


@estimator("torque, LS", uses="poses, torque")
def least_squares(evidence: Evidence) -> Estimate:
    """Ordinary least squares: all joints count alike."""
    return _solved(evidence, time.perf_counter(), weighted=False)


@estimator("torque, weighted LS", uses="poses, torque")
def weighted_least_squares(evidence: Evidence) -> Estimate:
    """Least squares weighted by the residual of each joint."""
    return _solved(evidence, time.perf_counter(), weighted=True)


@estimator("encoders, weighted LS", uses="encoders, torque")
def encoder_route(evidence: Evidence) -> Estimate:
    """Weighted least squares on the poses that the encoders give, by forward kinematics: the
    conventional route.

    Forward kinematics of a parallel robot has no closed form: Newton's method solves all instants
    at once, each from the desired pose there, which the robot is never far from. Knows nothing of
    the camera. The note says what it took. Raises EstimationError where the angles belong to no
    pose near the desired one.
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
    """The estimate of a fit that began at `began` (`time.perf_counter`), from the measured poses or
    others (N, 6).
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
    """Equations of the measured torque and poses, or of other poses (N, 6).

    Raises EstimationError where the record has no torque.
    """
    run = evidence.run
    torque = evidence.joint_channels().torque
    return torque_equations(
        run, run.without_gaps() if poses is None else poses, torque, evidence.scenario
    )


def fit_equations(
    equations: TorqueEquations, guess: StartingGuess, weighted: bool
) -> tuple[Array, Array]:
    """Unknowns (u,) of the equations, and the standard deviation (2 n,) of the rows, N m or N.

    The deviations come from the residuals, of a joint or of all, and count the filter's
    correlation.
    """
    groups = equations.kind if weighted else equations.kind // equations.layout.joints
    noise = np.full(len(equations.right), 0.1)
    for _ in range(REWEIGHTINGS):
        rows = equations.whitened(noise)
        unknowns = bounded_fit(
            rows.matrix, rows.right, guess, ScaleAnchor("prior"), lower_bounds(guess.layout)
        )
        noise = row_noise(equations, unknowns, groups)
    return unknowns, noise


def row_noise(equations: TorqueEquations, unknowns: Array, groups: NDArray[np.intp]) -> Array:
    """Standard deviation (2 n,) of each row: the RMS residual of its group, as if all samples were
    independent.
    """
    squares = equations.residual(unknowns) ** 2
    rms = np.sqrt(np.bincount(groups, squares) / np.maximum(np.bincount(groups), 1))
    return np.maximum(rms, SMALLEST_NOISE_N_M)[groups] * np.sqrt(equations.correlation)


def information(rows: TorqueEquations, guess: StartingGuess) -> Array:
    """Information (u, u) of whitened rows and the starting guess."""
    _, std = prior_of(guess)
    return np.asarray(rows.matrix.T @ rows.matrix + np.diag(1 / std**2), dtype=float)


def standard_deviations(covariance: Array, count: int) -> Array:
    """Standard deviations (p,) of the first `count` unknowns, the parameters, from a covariance (u,
    u) of all.
    """
    return np.asarray(np.sqrt(np.diag(covariance))[:count], dtype=float)
