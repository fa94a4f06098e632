"""Inverse dynamics with measured torque by total least squares: the regression matrix has errors too.

Plain total least squares takes the errors of all columns as alike and independent; here they come from the same poses
through derivatives. So their second moments are drawn: the poses are disturbed by the sensor's noise, and the columns
follow. Of all x~ = (x, -1) the estimate minimises |A x~|^2 / |E x~|^2, with A = (W | tau) and E the drawn errors of
A: with A = Q R, the last right singular vector of E R^-1 turned round (generalised total least squares, Van Huffel and
Vandewalle, "The total least squares problem", SIAM 1991, chapter 10). Directions that the motion does not show
better than the starting guess are left there first (truncation), for the noise would otherwise rule them. All this
removes the bias, not the spread: where the errors are large the normal matrix less theirs is nearly singular, and the
deviations say so.
"""

import time
from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.warm_start import REWEIGHTINGS
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.least_squares import (
    DYNAMIC,
    UNKNOWNS,
    TorqueEquations,
    fit_equations,
    information,
    nearest_admissible,
    prior_of,
    torque_equations,
)
from identify.loop_parameters import NAMES
from identify.random_streams import DISTURBED_COPIES, mixed_generator

DRAWS = 4
"""Disturbed copies of a record: each has thousands of rows to average the errors over."""

SHOWN = 3.0
"""A direction counts as shown by the motion when it is known this many times better than before."""

NOT_GENERIC = 1e-12
"""Part of the right side in the singular vector, relative to its largest entry, below which there is no solution."""


@dataclass(frozen=True)
class TlsFit:
    """Solution (p,) and its covariance (p, p) to first order, in the units of the scaled unknowns."""

    solution: Array
    covariance: Array


def total_least_squares(evidence: Evidence) -> Estimate:
    """Total least squares with drawn errors of the columns.

    Raises EstimationError where a solution is not generic: the torque column has no part in it.
    """
    began = time.perf_counter()
    guess, torque = evidence.problem.guess, evidence.joint_channels().torque
    poses, scenario = evidence.run.without_gaps(), evidence.scenario
    equations = torque_equations(evidence.run, poses, torque, scenario.timing, scenario.filter)
    _, noise = fit_equations(equations, guess, weighted=True)
    errors = _drawn_errors(evidence, equations, poses, torque, noise)
    values, std = prior_of(guess)
    rows, half = equations.whitened(noise), len(noise) // 2
    unknowns, deviations = values.copy(), std.copy()
    for block, columns in ((slice(0, half), slice(0, DYNAMIC)), (slice(half, None), slice(DYNAMIC, UNKNOWNS))):
        fit = _fit_block(rows.matrix[block, columns], rows.right[block], errors[:, block], columns, values, std)
        unknowns[columns] += std[columns] * fit.solution
        deviations[columns] *= np.sqrt(np.diag(fit.covariance))
    admissible = nearest_admissible(unknowns, information(rows, guess), std)
    seconds = time.perf_counter() - began
    return Estimate(admissible[: len(NAMES)], deviations[: len(NAMES)], seconds, REWEIGHTINGS + 1, 0)


def truncated_tls(matrix: Array, right: Array, errors: Array) -> TlsFit:
    """x (p,) of matrix (n, p) x = right (n,) by generalised total least squares in the directions shown.

    Rows have the standard deviation 1, and nothing beyond 0 with deviation 1 is known of x beforehand.
    errors (draws, n, p + 1): drawn errors of (matrix | right).
    Raises EstimationError where the right side has no part in the smallest singular vector.
    """
    size = matrix.shape[1]
    _, singular, directions = np.linalg.svd(matrix, full_matrices=False)
    shown = directions[singular > SHOWN]
    joined = np.column_stack([matrix @ shown.T, right])
    drawn = np.concatenate([np.column_stack([one[:, :-1] @ shown.T, one[:, -1]]) for one in errors])
    drawn /= np.sqrt(len(errors))
    triangle = np.asarray(np.linalg.qr(joined, mode="r"))
    turned = np.linalg.solve(triangle.T, drawn.T).T
    _, largest, vectors = np.linalg.svd(turned, full_matrices=False)
    vector = np.linalg.solve(triangle, vectors[0])
    if abs(vector[-1]) < NOT_GENERIC * np.abs(vector).max():
        raise EstimationError(
            f"total least squares is not generic: the right side has a part of {vector[-1]:.1e} in a solution of size "
            f"{np.abs(vector).max():.1e}"
        )
    solution = -shown.T @ (vector[:-1] / vector[-1])
    normal = joined[:, :-1].T @ joined[:, :-1]
    inverse = np.linalg.inv(normal - drawn[:, :-1].T @ drawn[:, :-1] / largest[0] ** 2)
    covariance = shown.T @ (inverse @ normal @ inverse) @ shown + np.eye(size) - shown.T @ shown
    return TlsFit(np.asarray(solution, dtype=float), np.asarray(covariance, dtype=float))


def _fit_block(matrix: Array, right: Array, errors: Array, columns: slice, values: Array, std: Array) -> TlsFit:
    """Fit of one block of unknowns, counted from the starting guess in its standard deviations."""
    block = errors[..., [*range(UNKNOWNS)[columns], -1]]
    block[..., -1] -= block[..., :-1] @ values[columns]
    scale = std[columns]
    return truncated_tls(matrix * scale, right - matrix @ values[columns], block * np.append(scale, 1.0))


def _drawn_errors(evidence: Evidence, equations: TorqueEquations, poses: Array, torque: Array, noise: Array) -> Array:
    """Errors (draws, 2 n, 74) of the whitened columns and right side, from drawn noise of poses and torques."""
    rng = mixed_generator(DISTURBED_COPIES)
    factor = np.linalg.cholesky(evidence.run.covariance)
    scenario, drawn = evidence.scenario, []
    for _ in range(DRAWS):
        moved = poses + rng.standard_normal(poses.shape) @ factor.T
        read = torque + evidence.joint_channels().torque_std * rng.standard_normal(torque.shape)
        other = torque_equations(evidence.run, moved, read, scenario.timing, scenario.filter, equations.slipping)
        differences = np.column_stack([other.matrix - equations.matrix, other.right - equations.right])
        drawn.append(differences / noise[:, None])
    return np.stack(drawn)
