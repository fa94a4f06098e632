"""Inverse dynamics with measured torque by least squares: ordinary, and weighted by what each joint leaves unexplained.

Noise in the poses gets into the regression matrix through both derivatives, which draws the estimates towards zero: no
number of samples removes that bias. Weights: Gautier, "Dynamic identification of robots with power model", ICRA 1997.
"""

import time

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.estimation.scale_anchor import ScaleAnchor
from identify.estimation.warm_start import REWEIGHTINGS, bounded_fit
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.torque_equations import TorqueEquations, lower_bounds, prior_of, torque_equations
from identify.loop_parameters import NAMES, StartingGuess

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
