"""Inverse dynamics by least squares: measured torque, ordinary and weighted; or crank angles from encoders.

Equations of a run with measured joint torques: linear in the dynamic parameters, and in the joint PID's.
With tau the filtered torque of a slipping joint, at every instant (eq. 17 and 25; eq. 31)

    (J_ad^-T Gamma(chi, v, v_dot) Xi)_j = tau_j
    lp (U - theta)_j + li integral(U - theta)_j + ld (U_dot - theta_dot)_j + z_j = tau_j

Both stand in one system with the unknowns Xi, lp, li, ld and the starting torques z (6,). The measured torque gives
the scale: no anchor is needed. What the motion does not show is left to the starting guess with its deviations.

Inverse dynamics with measured torque by least squares: ordinary, and weighted by what each joint leaves unexplained.
Noise in the poses gets into the regression matrix through both derivatives, which draws the estimates towards zero: no
number of samples removes that bias. Weights: Gautier, "Dynamic identification of robots with power model", ICRA 1997.

The conventional route: crank angles from encoders, poses from forward kinematics, then inverse dynamics.
Forward kinematics of a parallel robot has no closed form: Newton's method solves all instants at once, each from the
desired pose there, which the robot is never far from. Knows nothing of the camera.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dynamics import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.scale_anchor import ScaleAnchor
from identify.estimation.warm_start import REWEIGHTINGS, bounded_fit, joint_balance
from identify.estimators.evidence import Estimate, Evidence
from identify.filtering import zero_phase_filter
from identify.loop_parameters import NAMES, StartingGuess
from identify.record.recorded_run import RecordedRun
from identify.scenario import Filter, Timing

DYNAMIC, UNKNOWNS = 64, len(NAMES) + 6

FREE_TORQUE_N_M = 1e3
"""Standard deviation of a starting torque before the experiment: nothing is known of it."""


@dataclass(frozen=True)
class TorqueEquations:
    """matrix (2 n, 73) times unknowns = right (2 n,), N m: n rows of the dynamics, then the same of the controller.

    kind (2 n,): 0 to 5 dynamics of each joint, 6 to 11 its controller; correlation: samples to one independent sample,
    because a low-pass filter of cutoff f leaves 2 f independent ones a second; slipping (N, 6): which rows stand here.
    """

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
    run: RecordedRun,
    poses: Array,
    torque: Array,
    timing: Timing,
    filtering: Filter,
    slipping: NDArray[np.bool_] | None = None,
) -> TorqueEquations:
    """Equations of poses (N, 6) and torques (N, 6) of a run with its logged commands; those of the joints that slip, or
    of the ones given (N, 6)."""
    balance, found = joint_balance(run.robot, poses, run.logged, timing, filtering)
    rows = found if slipping is None else slipping
    columns = balance[rows]
    smooth = zero_phase_filter(torque, timing.frame_rate_hz, filtering.cutoff_hz, filtering.order)[rows]
    matrix = np.zeros((2 * len(columns), UNKNOWNS))
    matrix[: len(columns), :DYNAMIC] = columns[:, :DYNAMIC]
    matrix[len(columns) :, DYNAMIC:] = -columns[:, DYNAMIC:]
    joint = np.nonzero(rows)[1]
    right = np.concatenate([smooth - columns[:, :DYNAMIC] @ run.payload[:DYNAMIC], smooth])
    correlation = max(1.0, timing.frame_rate_hz / (2 * filtering.cutoff_hz))
    return TorqueEquations(matrix, right, np.concatenate([joint, joint + 6]), correlation, rows)


def prior_of(guess: StartingGuess) -> tuple[Array, Array]:
    """Values (73,) and standard deviations (73,) of the unknowns before the experiment."""
    values = np.concatenate([guess.values, np.zeros(6)])
    return values, np.concatenate([guess.std, np.full(6, FREE_TORQUE_N_M)])


def lower_bounds() -> Array:
    """Lower bounds (73,): parameters and gains are not negative, starting torques are free."""
    return np.concatenate([np.zeros(len(NAMES)), np.full(6, -np.inf)])


def nearest_admissible(unknowns: Array, information: Array, scale: Array) -> Array:
    """Unknowns (73,) within their bounds that are nearest in the metric of the information matrix (73, 73)."""
    lower = lower_bounds()
    if (unknowns >= lower).all():
        return unknowns
    factor = np.linalg.cholesky(information * np.outer(scale, scale)).T
    solved = lsq_linear(factor, factor @ (unknowns / scale), bounds=(lower / scale, np.inf), method="bvls")
    return np.maximum(solved.x * scale, lower)


SMALLEST_NOISE_N_M = 1e-9


def least_squares(evidence: Evidence) -> Estimate:
    """Ordinary least squares: all joints count alike."""
    return _from_poses(evidence, weighted=False)


def weighted_least_squares(evidence: Evidence) -> Estimate:
    """Least squares weighted by the residual of each joint."""
    return _from_poses(evidence, weighted=True)


def fit_equations(equations: TorqueEquations, guess: StartingGuess, weighted: bool) -> tuple[Array, Array]:
    """Unknowns (73,) of the equations, and the standard deviation (2 n,) of the rows, N m.

    The deviations come from the residuals, of a joint or of all, and count the filter's correlation.
    """
    groups = equations.kind if weighted else equations.kind // 6
    noise = np.full(len(equations.right), 0.1)
    for _ in range(REWEIGHTINGS):
        rows = equations.whitened(noise)
        unknowns = bounded_fit(rows.matrix, rows.right, guess, ScaleAnchor("prior"), lower_bounds())
        noise = row_noise(equations, unknowns, groups)
    return unknowns, noise


def row_noise(equations: TorqueEquations, unknowns: Array, groups: NDArray[np.intp]) -> Array:
    """Standard deviation (2 n,) of each row: the RMS residual of its group, as if all samples were independent."""
    squares = equations.residual(unknowns) ** 2
    rms = np.sqrt(np.bincount(groups, squares) / np.maximum(np.bincount(groups), 1))
    return np.maximum(rms, SMALLEST_NOISE_N_M)[groups] * np.sqrt(equations.correlation)


def information(rows: TorqueEquations, guess: StartingGuess) -> Array:
    """Information (73, 73) of whitened rows and the starting guess."""
    _, std = prior_of(guess)
    return np.asarray(rows.matrix.T @ rows.matrix + np.diag(1 / std**2), dtype=float)


def standard_deviations(covariance: Array) -> Array:
    """Standard deviations (67,) of the parameters from a covariance (73, 73) of the unknowns."""
    return np.asarray(np.sqrt(np.diag(covariance))[: len(NAMES)], dtype=float)


def solved(equations: TorqueEquations, guess: StartingGuess, weighted: bool, began: float) -> Estimate:
    """The estimate of a least-squares fit that began at `began` (`time.perf_counter`)."""
    unknowns, noise = fit_equations(equations, guess, weighted)
    seconds = time.perf_counter() - began
    covariance = np.asarray(np.linalg.inv(information(equations.whitened(noise), guess)), dtype=float)
    std = standard_deviations(covariance)
    return Estimate(unknowns[: len(NAMES)], std, seconds, REWEIGHTINGS, 0)


def _from_poses(evidence: Evidence, weighted: bool) -> Estimate:
    began = time.perf_counter()
    run, scenario = evidence.run, evidence.scenario
    torque = evidence.joint_channels().torque
    equations = torque_equations(run, run.without_gaps(), torque, scenario.timing, scenario.filter)
    return solved(equations, evidence.problem.guess, weighted, began)


def encoder_route(evidence: Evidence) -> Estimate:
    """Weighted least squares on the poses that the encoders give; the note says what forward kinematics took.

    Raises EstimationError where the angles belong to no pose near the desired one.
    """
    began = time.perf_counter()
    run, scenario, channels = evidence.run, evidence.scenario, evidence.joint_channels()
    try:
        poses = run.robot.forward_kinematics(channels.angle, run.reference.poses)
    except DynamicsError as error:
        raise EstimationError(f"the encoders' angles give no poses: {error}") from None
    took = time.perf_counter() - began
    equations = torque_equations(run, poses, channels.torque, scenario.timing, scenario.filter)
    estimate = solved(equations, evidence.problem.guess, True, began)
    note = f"forward kinematics of {len(poses)} frames: {took:.3f} s"
    return replace(estimate, note=note)
