"""Covariance of an output-error estimate, by propagating through the experiment what is not known
exactly.

Sensor noise enters twice: in the measured poses, and through the servo in the plant's motion, which
a model that closes its own loop cannot follow (its residuals are coloured, and stick-slip makes the
response nonlinear). So the experiment is repeated on the identified model with drawn noise: each
draw gives residuals r, and their scores J^T r spread as those of the real record do. With W the
information of data and prior, the covariance of the estimate is W^-1 (cov(J^T r) + prior
information) W^-1. Of the latter, the part of the starting guess is what its errors alone would make
of the estimate: they are the same in every record that is taken. A model driven by the logged
commands has white residuals, and W^-1 is all. Where either misses the record by more than noise
explains, what its error does to the scores is added (`explanation`). It is all computed in units
where W is one.

Errors that all poses of a record have in common, of cameras, teaching, clocks and geometry, are
parameters of the same problem: their modes M stand in J behind the others, and each is known
beforehand to one standard deviation. So the record says what it taught of them, and how far that
and the parameters err together. The search estimates those of every record apart; where records
share one draw of them, the covariance of the estimate is that of a shared draw.

A known load errs, too. Under the load L the model has the parameters p + L: an error of the load
moves the residuals of its records by J dL, with J their Jacobian by the parameters, and the scores
by J^T J dL. With S the covariance of the load, the scores spread by H S H beside the noise, where H
= J^T J sums over all records made under this load. Where the load shows the scale, one that is a
percent heavier than stated makes all parameters about a percent too small.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from dynamics.closed_loop import ClosedLoopRun, LoopFailure
from dynamics.parameters import LANES
from identify.arrays import Array, triangular_factor
from identify.errors import EstimationError
from identify.estimation.common_errors import covariance_by_kind, most_likely_of, shared_draws
from identify.estimation.explanation import Misfit, coloured_score_covariance, misfit_of_white
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.progress import Advance
from identify.runtime import cores

DRAWS = 100
"""Repetitions: they know a standard deviation to 7 %."""

FEWEST = 50
"""Repetitions that must have run to their end."""


@dataclass(frozen=True)
class Uncertainty:
    """What is known of an estimate (p,), were there no bounds.

    whole (p + k, p + k): covariance of the estimate, and behind it of the k numbers, record by
    record, of which what poses have in common is made, in their standard deviations beforehand.
    of_guess (p, p): the part of the estimate's covariance that errors of the starting guess make,
    and of_common, by their kinds, what those in common make; information (p, p) that the poses
    alone hold; gradient (p,): J^T r of poses and all that is known beside them, at the estimate;
    misfit of the record; unstable: repeated experiments that ended early and were left out.
    """

    whole: Array
    of_guess: Array
    of_common: dict[str, Array]
    information: Array
    gradient: Array
    misfit: Misfit
    unstable: int = 0

    @property
    def covariance(self) -> Array:
        """Of the estimate (p, p)."""
        return self.whole[: len(self.gradient), : len(self.gradient)]

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=float)

    def warnings(self) -> tuple[str, ...]:
        """A misfit that the sensor's noise does not explain, and a model whose loop is close to
        unstable.
        """
        if not self.unstable:
            return self.misfit.warnings()
        return (
            *self.misfit.warnings(),
            f"of {DRAWS} simulated repetitions of the experiment on the identified model "
            f"{self.unstable} were "
            "unstable, and are left out of the intervals: the loop is close to instability",
        )


def estimate_uncertainty(
    problem: OutputErrorProblem,
    parameters: Array,
    rng: np.random.Generator,
    advance: Advance = lambda n=1: None,
) -> Uncertainty:
    """Uncertainty of the estimate `parameters` (p,), from DRAWS repeated experiments.

    Raises EstimationError when too many of them are unstable.
    """
    runs = problem.runs
    size = len(parameters)
    linear = _linearised(runs, parameters)
    pairs = list(zip(runs, linear, strict=True))
    found = [(run.without_common(one.missed), run.without_common(one.slopes)) for run, one in pairs]
    known, known_rows = problem.known(parameters)
    gradient = known @ known_rows + sum(np.tensordot(r, j, 2) for r, j in found)
    information = np.asarray(sum(_information(j) for _, j in found))
    whole, (firsts, drawn) = linear[0].rows.shape[2], shared_draws(runs)
    all_known = block_diag(known_rows, np.eye(whole - size))
    units = _units([all_known, *(one.rows.reshape(-1, whole) for one in linear)])
    shown = [replace(one, rows=one.rows @ units) for one in linear]
    scores, misfit, unstable = _noise(problem, parameters, shown, rng, advance)
    if misfit.significant:
        model = sum(
            coloured_score_covariance(one.left, one.rows, run.ok)
            for run, one in zip(runs, shown, strict=True)
        )
        scores = scores + misfit.share_of_model * model
    if any(run.payload_std.any() for run in runs):
        moved = [np.tensordot(one.rows, one.slopes, ((0, 1), (0, 1))) for one in shown]
        scores = scores + load_score_covariance(runs, moved)
    beforehand = _information(known_rows @ units[:size]) + _information(drawn.T @ units[size:])
    covariance = units @ (scores + beforehand) @ units.T
    return Uncertainty(
        (covariance + covariance.T) / 2,
        _information(problem.guess.rows @ units[:size] @ units[:size].T),
        covariance_by_kind(firsts, units[:size] @ units[size:].T @ drawn),
        information,
        np.asarray(gradient),
        misfit,
        unstable,
    )


@dataclass(frozen=True)
class _Linear:
    """Of one record, in standard deviations of the noise: what the model misses (n, 6), its
    derivatives by the parameters (n, 6, p) and by the parameters and all numbers in common, of
    whichever record (n, 6, p + k), and its own modes (n, 6, k)."""

    missed: Array
    slopes: Array
    rows: Array
    modes: Array

    @property
    def left(self) -> Array:
        """What it misses (n, 6) with the most likely common errors."""
        modes = self.modes.reshape(self.missed.size, -1)
        return self.missed + self.modes @ most_likely_of(modes, self.missed.ravel())


def _linearised(runs: Sequence[LoopModel], parameters: Array) -> list[_Linear]:
    """Of each run, with the numbers in common record by record behind the parameters (p,)."""
    modes = [run.whitened_modes for run in runs]
    counts = [one.shape[2] for one in modes]
    found = []
    for number, (run, own) in enumerate(zip(runs, modes, strict=True)):
        missed, slopes = run.residuals_in_noise(parameters)
        before, after = (
            np.zeros((*missed.shape, sum(some))) for some in (counts[:number], counts[number + 1 :])
        )
        found.append(
            _Linear(missed, slopes, np.concatenate([slopes, before, own, after], axis=2), own)
        )
    return found


def load_score_covariance(runs: Sequence[LoopModel], information: Sequence[Array]) -> Array:
    """Covariance (q, q) of the scores T^T J^T r that the loads' standard deviations make, to first
    order.

    information: T^T J^T J (q, p) of each run's residuals. Runs that state the same load, equally
    well known, share its error; different loads err independently.
    """
    shown: dict[tuple[float, ...], Array] = {}
    for run, one in zip(runs, information, strict=True):
        load = (*run.payload, *run.payload_std)
        shown[load] = shown.get(load, np.zeros_like(one)) + one
    spread = [total * np.array(load[total.shape[1] :]) for load, total in shown.items()]
    return np.asarray(sum(one @ one.T for one in spread), dtype=float)


def _units(rows: list[Array]) -> Array:
    """Matrix T (p, p) with T^T W T = 1, where W is the information of all rows (n, p) together, and
    so W^-1 = T T^T.

    From the rows themselves: W has the square of their condition number, beyond what its inverse
    can bear where a record contradicts the model.
    """
    triangle = triangular_factor(np.vstack(rows))
    return np.asarray(solve_triangular(triangle, np.eye(triangle.shape[1])))


def _information(jacobian: Array) -> Array:
    """J^T J (p, p) of rows (..., p)."""
    rows = jacobian.reshape(-1, jacobian.shape[-1])
    return np.asarray(rows.T @ rows, dtype=float)


def _noise(
    problem: OutputErrorProblem,
    parameters: Array,
    found: list[_Linear],
    rng: np.random.Generator,
    advance: Advance,
) -> tuple[Array, Misfit, int]:
    """Covariance (q, q) of the scores that noise makes, the misfit beyond it, and how many
    repetitions ended early.

    found: of each run, its rows in the units of the scores. Where the model's error decides, or its
    residuals are white, no experiment is repeated.
    """
    runs = zip(problem.runs, found, strict=True)
    white = misfit_of_white(np.concatenate([run.without_common(one.missed) for run, one in runs]))
    if white.decides or all(run.driven for run in problem.runs):
        advance(DRAWS)
        return np.asarray(sum(_information(one.rows) for one in found)), white, 0
    scores, squares = _repeated_scores(problem, parameters, found, rng, advance)
    unstable = DRAWS - len(scores)
    if len(scores) < FEWEST:
        raise EstimationError(
            f"{unstable} of {DRAWS} repeated experiments on the identified model ended in an "
            "unstable loop: "
            "its servo cannot bear the sensor's noise, and no interval can be given"
        )
    misfit = Misfit(white.found, float(np.mean(squares)), float(np.std(squares, ddof=1)))
    return np.cov(scores.T), misfit, unstable


def _repeated_scores(
    problem: OutputErrorProblem,
    parameters: Array,
    found: list[_Linear],
    rng: np.random.Generator,
    advance: Advance,
) -> tuple[Array, list[float]]:
    """Scores J^T r (draws, q) of noise and mean squared residuals of noise and common errors, of
    the repeated experiments whose loop is stable."""

    def judged(
        repeated: Sequence[ClosedLoopRun], draws: np.random.Generator
    ) -> tuple[Array, float]:
        noise = [
            one.missed + run.whiten(run.measured - made.measured)
            for run, one, made in zip(problem.runs, found, repeated, strict=True)
        ]
        drawn = [
            run.without_common(residual + one.modes @ draws.standard_normal(one.modes.shape[2]))
            for run, one, residual in zip(problem.runs, found, noise, strict=True)
        ]
        return np.concatenate(noise), float(np.mean(np.concatenate(drawn) ** 2))

    def repeat(draws: Sequence[np.random.Generator]) -> list[tuple[Array, float] | None]:
        runs = [repeated_experiments(run, parameters, draws) for run in problem.runs]
        return [
            None if any(isinstance(one, LoopFailure) for one in repeated) else judged(repeated, own)
            for own, *repeated in zip(draws, *runs, strict=True)
        ]

    results = []
    each = rng.spawn(DRAWS)
    with ThreadPoolExecutor(cores()) as pool:  # the compiled loop runs without Python's lock
        for some in pool.map(repeat, [each[k : k + LANES] for k in range(0, DRAWS, LANES)]):
            results += [result for result in some if result]
            advance(len(some))
    rows = np.concatenate([one.rows.reshape(-1, one.rows.shape[2]) for one in found])
    drawn = np.array([noise.ravel() for noise, _ in results]).reshape(len(results), len(rows))
    return drawn @ rows, [
        square for _, square in results
    ]  # scores of all at once: each reads the rows otherwise


def repeated_experiments(
    run: LoopModel, parameters: Array, draws: Sequence[np.random.Generator]
) -> list[ClosedLoopRun | LoopFailure]:
    """Repeated experiments, one for each generator, whose plant is the identified model and whose
    sensor has drawn noise; NaN where lost. In place of one whose loop is unstable its LoopFailure.
    """
    root = np.linalg.cholesky(run.covariance).T
    return run.simulate_repeats(
        parameters, np.stack([rng.standard_normal(run.measured.shape) @ root for rng in draws])
    )


def correlation_matrix(covariance: Array) -> Array:
    """Correlations (n, n) of a covariance (n, n) with positive variances."""
    std = np.sqrt(np.diag(covariance))
    correlations = np.asarray(covariance / np.outer(std, std), dtype=float)
    np.fill_diagonal(correlations, 1.0)
    return correlations


def strongest_pairs(correlations: Array, names: Sequence[str], count: int) -> list[dict[str, Any]]:
    """The `count` pairs with the largest correlations (n, n) in size, the largest first: first,
    second, correlation.
    """
    rows, columns = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(correlations[rows, columns]), kind="stable")[:count]
    return [
        {"first": names[i], "second": names[j], "correlation": float(correlations[i, j])}
        for i, j in zip(rows[order], columns[order], strict=True)
    ]
