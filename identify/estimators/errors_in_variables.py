"""Inverse dynamics with errors in the regression matrix.

The two methods are instrumental variables and total least squares.

The equations are W x = tau, with the regression matrix W of the measured poses. Instrumental
variables Z are the same matrix computed from a simulated run of the current model. They are free of
measurement noise and correlated with the true motion. The solution of Z^T (W x - tau) = 0 is
therefore unbiased, unlike that of least squares (Janot, Vandanjon, Gautier, "A generic instrumental
variable approach for industrial robot identification", IEEE TCST 22(1), 2014). The model closes its
own loop, because logged commands would bring the sensor's noise into the instruments.

Plain total least squares assumes equal and independent errors of all columns. Here all columns are
computed from the same poses. Therefore the second moments of their errors are sampled: the poses
are disturbed by random sensor noise, and the columns are computed again. The estimate x~ = (x, -1)
minimises |A x~|^2 / |E x~|^2, with A = (W | tau) and E the sampled errors of A. With A = Q R, x~ is
R^-1 times the first right singular vector of E R^-1 (generalised total least squares, Van Huffel
and Vandewalle, "The total least squares problem", SIAM 1991, chapter 10).

Total least squares first fixes directions at the initial guess if the motion does not determine
them SHOWN times better (truncation), because noise would dominate them. Both methods remove the
bias, but not the scatter. If the errors are large, the normal matrix minus the second moments of
the errors is nearly singular, and the standard deviations are large.
"""

import time
from dataclasses import replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.prior import StartingGuess
from identify.estimation.warm_start import REWEIGHTINGS
from identify.estimators.estimator import Estimate, Evidence, estimator
from identify.estimators.least_squares import (
    TorqueEquations,
    fit_equations,
    information,
    measured_equations,
    nearest_admissible,
    prior_of,
    row_noise,
    standard_deviations,
    torque_equations,
)
from identify.random_streams import DISTURBED_COPIES, mixed_generator

MAX_ITERATIONS = 10  # largest number of simulated runs
# Largest step of a parameter at convergence, as a fraction of its standard deviation.
STEP_TOLERANCE = 0.05


@estimator("torque, IV", uses="poses, torque")
def instrumental_variables(evidence: Evidence) -> Estimate:
    """Estimate with instruments from simulated runs, starting at weighted least squares.

    Each run simulates the current estimate. Raises EstimationError if the model of an estimate is
    unstable, or if the record has no joint channels.
    """
    began = time.perf_counter()
    equations = measured_equations(evidence)
    guess = evidence.problem.guess
    unknowns, noise = fit_equations(equations, guess, weighted=True)
    count = len(guess.values)
    runs = 0
    change = np.array([np.inf])
    while change.max() > STEP_TOLERANCE and runs < MAX_ITERATIONS:
        instruments = _simulated_matrix(evidence, equations, unknowns[:count])
        new, covariance = iv_fit(equations, instruments, noise, guess)
        change = np.abs(new - unknowns)[:count] / standard_deviations(covariance, count)
        unknowns = new
        noise = row_noise(equations, new, equations.kind)
        runs = runs + 1
    seconds = time.perf_counter() - began
    note = f"last step {change.max():.2g} standard deviations"
    std = standard_deviations(covariance, count)
    return Estimate(unknowns[:count], std, seconds, REWEIGHTINGS + runs, runs, note)


def iv_fit(
    equations: TorqueEquations, instruments: Array, noise: Array, guess: StartingGuess
) -> tuple[Array, Array]:
    """Solve Z^T (W x - tau) = 0 in whitened rows, with the initial guess as a prior.

    instruments: Z (2 m, u). noise (2 m,): standard deviations of the rows, N m or N. Returns the
    unknowns x (u,), moved to within their bounds, and their covariance (u, u) without bounds.
    """
    values, std = prior_of(guess)
    rows = equations.whitened(noise)
    z = instruments / noise[:, None]
    prior = np.eye(len(std))
    # In units of the prior standard deviations the prior is the identity.
    normal = (z.T @ rows.matrix) * np.outer(std, std) + prior
    moment = std * (z.T @ (rows.right - rows.matrix @ values))
    inverse = np.linalg.inv(normal)
    # Covariance of Z^T (W x - tau), with the prior.
    scores = (z.T @ z) * np.outer(std, std) + prior
    covariance = inverse @ scores @ inverse.T * np.outer(std, std)
    unknowns = values + std * (inverse @ moment)
    return nearest_admissible(guess.layout, unknowns, scores / np.outer(std, std), std), covariance


def _simulated_matrix(evidence: Evidence, equations: TorqueEquations, parameters: Array) -> Array:
    """Return the regression matrix (2 m, u) of the simulated closed loop, for the same rows."""
    try:
        simulated = evidence.run.simulate(parameters)
    except DynamicsError as error:
        raise EstimationError(
            f"no instruments: the model of the current estimate is unstable: {error}"
        ) from None
    noise_free = replace(evidence.run, logged=simulated.command)
    problem = evidence.problem
    return torque_equations(
        problem, noise_free, simulated.pose, simulated.torque, equations.slipping
    ).matrix


# Number of disturbed copies of a record. Few are enough, because each has thousands of rows.
DRAWS = 4
SHOWN = 3.0  # factor by which the motion must determine a direction better than the prior
# Last entry of the singular vector, as a fraction of its largest entry, below which there is no
# solution. The last entry belongs to the right-hand side of the equations.
NOT_GENERIC = 1e-12


@estimator("torque, total LS", uses="poses, torque")
def total_least_squares(evidence: Evidence) -> Estimate:
    """Estimate by total least squares with sampled errors of the columns.

    Raises EstimationError if the solution is not generic, which means that the torques have no part
    in the singular vector, or if the record has no joint channels.
    """
    began = time.perf_counter()
    equations = measured_equations(evidence)
    guess = evidence.problem.guess
    _, noise = fit_equations(equations, guess, weighted=True)
    errors = _drawn_errors(evidence, equations, noise)
    values, std = prior_of(guess)
    rows = equations.whitened(noise)
    half = len(noise) // 2
    unknowns = values.copy()
    deviations = std.copy()
    dynamic = guess.layout.dynamic
    count = len(guess.values)
    # Rows of the dynamics and rows of the controller have no unknown in common.
    blocks = ((slice(0, half), dynamic), (slice(half, None), slice(dynamic.stop, len(std))))
    for block, columns in blocks:
        matrix = rows.matrix[block, columns]
        rhs = rows.right[block]
        solution, covariance = _fit_block(matrix, rhs, errors[:, block], columns, values, std)
        unknowns[columns] += std[columns] * solution
        deviations[columns] *= np.sqrt(np.diag(covariance))
    admissible = nearest_admissible(guess.layout, unknowns, information(rows, guess), std)
    seconds = time.perf_counter() - began
    return Estimate(admissible[:count], deviations[:count], seconds, REWEIGHTINGS + 1)


def truncated_tls(matrix: Array, right: Array, errors: Array) -> tuple[Array, Array]:
    """Solve matrix x = right by generalised total least squares in the determined directions.

    The prior of each entry of x is 0 with the standard deviation 1. In the other directions, the
    solution is the prior.

    matrix (n, p)             Matrix of equations with the standard deviation 1.
    right (n,)                Right-hand side.
    errors (draws, n, p + 1)  Sampled errors of (matrix | right).

    Returns the solution x (p,), and its covariance (p, p) to first order. Raises EstimationError if
    the entry of the right-hand side in the singular vector is zero to rounding.
    """
    size = matrix.shape[1]
    _, singular, directions = np.linalg.svd(matrix, full_matrices=False)
    shown = directions[singular > SHOWN]
    joined = np.column_stack([matrix @ shown.T, right])
    drawn = np.concatenate([np.column_stack([one[:, :-1] @ shown.T, one[:, -1]]) for one in errors])
    drawn /= np.sqrt(len(errors))
    triangle = np.asarray(np.linalg.qr(joined, mode="r"))
    relative = np.linalg.solve(triangle.T, drawn.T).T
    _, largest, vectors = np.linalg.svd(relative, full_matrices=False)
    vector = np.linalg.solve(triangle, vectors[0])
    if abs(vector[-1]) < NOT_GENERIC * np.abs(vector).max():
        raise EstimationError(
            f"total least squares is not generic: the right side has a part of {vector[-1]:.1e} in "
            f"a solution of size {np.abs(vector).max():.1e}"
        )
    solution = -shown.T @ (vector[:-1] / vector[-1])
    normal = joined[:, :-1].T @ joined[:, :-1]
    inverse = np.linalg.inv(normal - drawn[:, :-1].T @ drawn[:, :-1] / largest[0] ** 2)
    # Along truncated directions, the prior variance of one remains.
    covariance = shown.T @ (inverse @ normal @ inverse) @ shown + np.eye(size) - shown.T @ shown
    return np.asarray(solution, dtype=float), np.asarray(covariance, dtype=float)


def _fit_block(
    matrix: Array, right: Array, errors: Array, columns: slice, values: Array, std: Array
) -> tuple[Array, Array]:
    """Fit one block of unknowns, as differences from the initial guess in standard deviations."""
    block = errors[..., [*range(len(std))[columns], -1]]
    block[..., -1] -= block[..., :-1] @ values[columns]
    scale = std[columns]
    return truncated_tls(
        matrix * scale, right - matrix @ values[columns], block * np.append(scale, 1.0)
    )


def _drawn_errors(evidence: Evidence, equations: TorqueEquations, noise: Array) -> Array:
    """Return sampled errors (draws, 2 m, u + 1) of the whitened columns and right-hand side.

    They follow from random noise of poses and torques.
    """
    rng = mixed_generator(DISTURBED_COPIES)
    run = evidence.run
    channels = evidence.joint_channels()
    factor = np.linalg.cholesky(run.covariance)
    poses = run.without_gaps()
    drawn = []
    for _ in range(DRAWS):
        disturbed = poses + rng.standard_normal(poses.shape) @ factor.T
        torque = channels.torque + channels.torque_std * rng.standard_normal(channels.torque.shape)
        copy = torque_equations(evidence.problem, run, disturbed, torque, equations.slipping)
        differences = np.column_stack(
            [copy.matrix - equations.matrix, copy.right - equations.right]
        )
        drawn.append(differences / noise[:, None])
    return np.stack(drawn)
