"""Covariance of an output-error estimate, by propagating the sensor's noise through the experiment.

Sensor noise enters twice: in the measured poses, and through the servo in the plant's motion, which a model that
closes its own loop cannot follow (its residuals are coloured, and stick-slip makes the response nonlinear). So the
experiment is repeated on the identified model with drawn noise: each draw gives residuals r, and their scores J^T r
spread as those of the real record do. With W the information of data and prior, the covariance of the estimate is
W^-1 (cov(J^T r) + prior information) W^-1. A model driven by the logged commands has white residuals, and W^-1 is all.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from dynamics.closed_loop import ClosedLoopRun, LoopFailure, simulate
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error import OutputErrorProblem
from identify.progress import Advance
from identify.record.recorded_run import RecordedRun

DRAWS = 100
"""Repetitions: they know a standard deviation to 7 %."""

NOISE_DECIDES = 3.0
"""Mean squared whitened residual beyond which the model's error, not the noise, decides: noise is not propagated then,
and the covariance is that of white residuals of the size found."""

MISFIT_STDS = 5.0
"""Standard deviations from the expected residual beyond which a warning is given."""

FEWEST = 50
"""Repetitions that must have run to their end."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariance (67, 67) of the estimate, were there no bounds; information (67, 67) that the poses alone hold;
    gradient (67,): J^T r of poses and all that is known beside them, at the estimate; mean squared whitened residual of
    the record, what noise alone would make of it, and how that spreads from one experiment to the next; unstable:
    repeated experiments that ended early and were left out."""

    covariance: Array
    information: Array
    gradient: Array
    noise_ratio: float
    expected_noise_ratio: float
    noise_ratio_std: float
    unstable: int = 0

    def warnings(self) -> tuple[str, ...]:
        """A misfit that the sensor's noise does not explain (a local minimum, or a model that is wrong), and a model
        whose loop is close to unstable."""
        said = []
        if abs(self.noise_ratio - self.expected_noise_ratio) > MISFIT_STDS * self.noise_ratio_std:
            said.append(
                f"the model misses the record by {self.noise_ratio:.3f} times the noise variance, noise alone gives "
                f"{self.expected_noise_ratio:.3f} ± {self.noise_ratio_std:.3f}: the model or the stated covariance is "
                "wrong, and the intervals are too"
            )
        if self.unstable:
            said.append(
                f"{self.unstable} of {DRAWS} repeated experiments on the identified model were unstable and are left "
                "out of the intervals"
            )
        return tuple(said)


def estimate_uncertainty(
    problem: OutputErrorProblem, parameters: Array, rng: np.random.Generator, advance: Advance = lambda n=1: None
) -> Uncertainty:
    """Uncertainty of the estimate `parameters` (67,), from DRAWS repeated experiments.

    Raises EstimationError when too many of them are unstable.
    """
    size = len(parameters)
    residuals, jacobians = [], []
    for run in problem.runs:
        residual, jacobian = run.residuals(parameters)
        residuals.append(residual)
        jacobians.append(jacobian.reshape(-1, size))
    ratio = float(np.mean(np.concatenate(residuals) ** 2))
    known, known_rows = problem.known(parameters)
    gradient = np.asarray(known @ known_rows + sum(r.ravel() @ j for r, j in zip(residuals, jacobians, strict=True)))
    prior = known_rows.T @ known_rows
    information = np.asarray(sum(j.T @ j for j in jacobians))
    inverse = np.linalg.inv(information + prior)
    if ratio > NOISE_DECIDES or all(run.driven for run in problem.runs):
        advance(DRAWS)
        covariance = (ratio if ratio > NOISE_DECIDES else 1.0) * (inverse + inverse.T) / 2
        spread = float(np.sqrt(2 / sum(map(len, jacobians))))
        return Uncertainty(covariance, information, gradient, ratio, 1.0, spread)
    scores, squares = _repeated_scores(problem, parameters, residuals, jacobians, rng, advance)
    if len(scores) < FEWEST:
        raise EstimationError(
            f"{DRAWS - len(scores)} of {DRAWS} repeated experiments on the identified model ended in an unstable loop: "
            "its servo cannot bear the sensor's noise, and no interval can be given"
        )
    covariance = inverse @ (np.cov(np.array(scores).T) + prior) @ inverse
    return Uncertainty(
        (covariance + covariance.T) / 2,
        information,
        gradient,
        ratio,
        float(np.mean(squares)),
        float(np.std(squares, ddof=1)),
        DRAWS - len(scores),
    )


def _repeated_scores(
    problem: OutputErrorProblem,
    parameters: Array,
    residuals: list[Array],
    jacobians: list[Array],
    rng: np.random.Generator,
    advance: Advance,
) -> tuple[list[Array], list[float]]:
    """Scores J^T r and mean squared residuals of the repeated experiments whose loop is stable."""

    def repeat(draws: np.random.Generator) -> tuple[Array, float] | None:
        try:
            repeated = [repeated_experiment(run, parameters, draws).measured for run in problem.runs]
        except LoopFailure:
            return None
        drawn = [
            (residual + run.whiten(run.measured - poses)).ravel()
            for run, residual, poses in zip(problem.runs, residuals, repeated, strict=True)
        ]
        score = np.asarray(sum(r @ j for r, j in zip(drawn, jacobians, strict=True)))
        return score, float(np.mean(np.concatenate(drawn) ** 2))

    found = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the compiled loop runs without Python's lock
        for result in pool.map(repeat, rng.spawn(DRAWS)):
            found += [result] if result else []
            advance()
    return [score for score, _ in found], [square for _, square in found]


def repeated_experiment(run: RecordedRun, parameters: Array, rng: np.random.Generator) -> ClosedLoopRun:
    """A repeated experiment whose plant is the identified model and whose sensor has drawn noise; NaN where lost.

    Raises LoopFailure where the loop is unstable.
    """
    noise = rng.standard_normal(run.measured.shape) @ np.linalg.cholesky(run.covariance).T
    return simulate(
        run.robot, parameters + run.payload, run.reference, run.settings, lost=~run.ok, noise=noise
    )
