"""Covariance of an output-error estimate, by propagating the sensor's noise through the experiment.

Sensor noise enters twice: in the measured poses, and through the servo in the plant's motion, which a model that
closes its own loop cannot follow (its residuals are coloured, and stick-slip makes the response nonlinear). So the
experiment is repeated on the identified model with drawn noise: each draw gives residuals r, and their scores J^T r
spread as those of the real record do. With W the information of data and prior, the covariance of the estimate is
W^-1 (cov(J^T r) + prior information) W^-1. A model driven by the logged commands has white residuals, and W^-1 is all.
"""

from dataclasses import dataclass

import numpy as np

from dynamics.closed_loop import simulate
from identify.arrays import Array
from identify.output_error import OutputErrorProblem
from identify.progress import Advance

DRAWS = 100
"""Repetitions: they know a standard deviation to 7 %."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariance (67, 67) of the estimate; mean squared whitened residual to expect from noise alone, and its spread
    from one experiment to the next."""

    covariance: Array
    expected_noise_ratio: float
    noise_ratio_std: float


def estimate_uncertainty(
    problem: OutputErrorProblem, parameters: Array, rng: np.random.Generator, advance: Advance = lambda n=1: None
) -> Uncertainty:
    """Uncertainty of the estimate `parameters` (67,), from DRAWS repeated experiments."""
    _, jacobian = problem.residuals(parameters)
    flat = jacobian.reshape(-1, len(parameters))
    data, known = flat.T @ flat, problem.known_information()
    inverse = np.linalg.inv(data + known)
    if problem.commands is not None:
        advance(DRAWS)
        count = 6 * int(problem.ok.sum())
        return Uncertainty((inverse + inverse.T) / 2, 1.0, float(np.sqrt(2 / count)))
    model = problem.model_poses(parameters)
    repeated = [_repeated_poses(problem, parameters, rng, advance) for _ in range(DRAWS)]
    residuals = np.array([problem.whiten(model - poses) for poses in repeated])
    scores = residuals.reshape(DRAWS, -1) @ flat
    covariance = inverse @ (np.cov(scores.T) + known) @ inverse
    squares = np.mean(residuals**2, axis=(1, 2))
    return Uncertainty((covariance + covariance.T) / 2, float(squares.mean()), float(squares.std(ddof=1)))


def _repeated_poses(
    problem: OutputErrorProblem, parameters: Array, rng: np.random.Generator, advance: Advance
) -> Array:
    """Measured poses (N, 6) of one repeated experiment whose plant is the identified model; NaN where lost."""
    noise = rng.standard_normal(problem.measured.shape) @ np.linalg.cholesky(problem.covariance).T

    def sensor(frame: int, t: float, pose: Array) -> Array | None:
        return pose + noise[frame] if problem.ok[frame] else None

    repeated = simulate(problem.robot, parameters, problem.reference, problem.settings, sensor)
    advance()
    return repeated.measured
