"""Covariance of an output-error estimate, from all uncertainties of the experiment.

`identify.estimation.intervals` computes the intervals from it.

Sensor noise acts twice: in the measured poses, and through the servo on the plant's motion. A model
that closes its own loop cannot follow the second effect. Its residuals are coloured, and stick-slip
makes the response nonlinear. Therefore the experiment is repeated on the identified model with
random noise. Each repetition gives residuals r. With their Jacobian J with respect to the
parameters, the scores J^T r have the same covariance as those of the real record. With W the
information of data and prior, the covariance of the estimate is W^-1 (cov(J^T r) + prior
information) W^-1. The prior information includes that of the initial guess. The part of the
covariance due to the guess is the effect of errors of the guess, which all records share.

A model driven by the logged commands has white residuals, and W^-1 is the whole covariance. If a
model misses the record by more than noise explains, the effect of its error on the scores is added
(`explanation`). All matrices are computed in units in which W is the identity.

Errors that all poses of a record have in common, of cameras, teaching, clocks and geometry, are
further unknowns of the same problem. Their modes M are further columns of J, and each has a prior
with standard deviation one. The covariance therefore contains their posterior covariance and their
correlation with the parameters. The search estimates the common errors of each record separately.
If records share the same errors, the covariance of the estimate takes this into account.

A known load has errors, too. Under the load L the model has the parameters p + L. An error dL moves
the residuals of the records under this load by J dL, and the scores by J^T J dL. With S the
covariance of the load, the covariance of the scores grows by H S H, where H is the sum of J^T J
over these records. For example, if the load fixes the scale and is one percent heavier than stated,
all parameters are about one percent too small.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from dynamics.closed_loop import ClosedLoopRun, LoopFailure
from dynamics.parameters import LANES
from identify.arrays import Array, triangular_factor
from identify.errors import EstimationError
from identify.estimation.common_error_estimates import (
    covariance_by_kind,
    errors_from_residuals,
    shared_draws,
)
from identify.estimation.explanation import Misfit, coloured_score_covariance, misfit_of_white
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.progress import Advance
from identify.runtime import in_threads

NOISE, MODEL, LOAD, GUESS, ANCHOR = "noise", "model", "load", "guess", "anchor"
"""Sources of uncertainty other than common errors: noise of the poses, error of the model, error of
a known load, errors of the initial guess, and error of the scale anchor.
"""
CORRELATED = "correlated"
"""Part due to prior covariances between kinds of common errors."""
ROUNDING = 1e-9
"""Largest difference of variances that counts as rounding, as a fraction of the variance."""

DRAWS = 100
"""Number of repetitions. They determine a standard deviation to 7 %."""

FEWEST = 50
"""Smallest allowed number of stable repetitions."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of an estimate without regard to bounds.

    whole (p + k, p + k)    Covariance of the estimate and the k common errors. The common errors
                            follow record by record, in units of their prior standard deviations.
    sources (p + k, p + k)  Parts of `whole` by source of the uncertainty: NOISE, MODEL, LOAD,
                            GUESS, ANCHOR, the kinds of common errors, and CORRELATED. Parts that do
                            not occur are left out. Up to rounding, their sum is `whole`.
    white (p, p)            Covariance of the estimate if the residuals were white.
    information (p, p)      Information of the poses alone.
    gradient (p,)           J^T r of poses and prior at the estimate, half the gradient of the cost.
    misfit                  Misfit of all records together.
    unstable                Number of unstable repetitions, which were left out.
    """

    whole: Array
    sources: dict[str, Array]
    white: Array
    information: Array
    gradient: Array
    misfit: Misfit
    unstable: int = 0

    @property
    def covariance(self) -> Array:
        """Covariance (p, p) of the estimate."""
        return self.whole[: len(self.gradient), : len(self.gradient)]

    @property
    def of_guess(self) -> Array:
        """Part (p, p) of the estimate's covariance due to errors of the initial guess."""
        size = len(self.gradient)
        return self.sources[GUESS][:size, :size]

    @property
    def of_common(self) -> dict[str, Array]:
        """Parts (p, p) of the estimate's covariance due to common errors, by their kinds."""
        size = len(self.gradient)
        kinds = self.sources.keys() - {NOISE, MODEL, LOAD, GUESS, ANCHOR, CORRELATED}
        return {kind: part[:size, :size] for kind, part in self.sources.items() if kind in kinds}

    @property
    def std(self) -> Array:
        """Standard deviations (p,) of the estimate."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=float)

    def warnings(self) -> tuple[str, ...]:
        """Return warnings of a misfit beyond noise, and of a nearly unstable loop."""
        if not self.unstable:
            return self.misfit.warnings()
        return (
            *self.misfit.warnings(),
            f"{self.unstable} of {DRAWS} simulated repetitions of the experiment on the identified "
            "model were unstable, and are left out of the intervals: the loop is close to "
            "instability",
        )


def estimate_uncertainty(
    problem: OutputErrorProblem,
    parameters: Array,
    rng: np.random.Generator,
    advance: Advance = lambda n=1: None,
) -> Uncertainty:
    """Return the uncertainty of an estimate (p,).

    problem: problem whose residuals are whitened for common errors at the estimate. If a model
    closes its own loop, and its error does not dominate the residuals, the effect of noise comes
    from DRAWS repeated experiments. Raises the EstimationError of `_noise`.
    """
    runs = problem.runs
    size = len(parameters)
    linear = _linearised(runs, parameters)
    pairs = list(zip(runs, linear, strict=True))
    whitened = [
        (run.without_common(one.missed), run.without_common(one.slopes)) for run, one in pairs
    ]
    known, known_rows = problem.known(parameters)
    gradient = known @ known_rows + sum(np.tensordot(r, j, 2) for r, j in whitened)
    information = np.asarray(sum(_information(j) for _, j in whitened))
    unknowns = linear[0].rows.shape[2]
    drawing, drawn = shared_draws(runs)
    all_known = block_diag(known_rows, np.eye(unknowns - size))
    units = _units([all_known, *(one.rows.reshape(-1, unknowns) for one in linear)])
    shown = [replace(one, rows=one.rows @ units) for one in linear]
    scores, misfit, unstable = _noise(problem, parameters, shown, rng, advance)
    by_scores = {NOISE: scores}
    if misfit.significant:
        # An error of the model lasts for many frames, so their residuals are correlated.
        model = sum(
            coloured_score_covariance(one.left, one.rows, run.ok)
            for run, one in zip(runs, shown, strict=True)
        )
        by_scores[MODEL] = np.asarray(misfit.share_of_model * model)
    if any(run.payload_errors.any() for run in runs):
        by_load = [np.tensordot(one.rows, one.slopes, ((0, 1), (0, 1))) for one in shown]
        by_scores[LOAD] = load_score_covariance(runs, by_load)
    scores = np.sum(list(by_scores.values()), axis=0)
    prior = _information(known_rows @ units[:size]) + _information(drawn.T @ units[size:])
    covariance = units @ (scores + prior) @ units.T
    # This removes asymmetry due to rounding.
    covariance = (covariance + covariance.T) / 2
    sources = {kind: units @ part @ units.T for kind, part in by_scores.items()}
    guessed, anchored = np.split(known_rows, [len(problem.guess.rows)])
    for kind, rows in ((GUESS, guessed), (ANCHOR, anchored)):
        if len(rows):
            sources[kind] = _information(rows @ units[:size] @ units.T)
    sources |= covariance_by_kind(drawing, units @ units[size:].T @ drawn)
    remainder = covariance - sum(sources.values())
    if (np.abs(np.diag(remainder)) > ROUNDING * np.diag(covariance)).any():
        sources[CORRELATED] = remainder
    return Uncertainty(
        covariance,
        sources,
        units[:size] @ units[:size].T,
        information,
        np.asarray(gradient),
        misfit,
        unstable,
    )


@dataclass(frozen=True)
class _Linear:
    """Linearisation of one record, in standard deviations of the noise.

    missed (n, 6): residuals of the model. slopes (n, 6, p): their derivatives with respect to the
    parameters. rows (n, 6, p + k): derivatives with respect to the parameters and the common errors
    of all records. modes (n, 6, own): modes of the common errors of this record.
    """

    missed: Array
    slopes: Array
    rows: Array
    modes: Array

    @property
    def left(self) -> Array:
        """Residuals (n, 6) that remain with the most likely common errors."""
        modes = self.modes.reshape(self.missed.size, -1)
        return self.missed + self.modes @ errors_from_residuals(modes, self.missed.ravel())


def _linearised(runs: Sequence[LoopModel], parameters: Array) -> list[_Linear]:
    """Return the linearisation of each run about the parameters (p,).

    The columns of the parameters come first, then the columns of the common errors by record.
    """
    modes = [run.whitened_modes for run in runs]
    counts = [one.shape[2] for one in modes]
    found = []
    for number, (run, own) in enumerate(zip(runs, modes, strict=True)):
        missed, slopes = run.noise_linearised(parameters)
        before = np.zeros((*missed.shape, sum(counts[:number])))
        after = np.zeros((*missed.shape, sum(counts[number + 1 :])))
        rows = np.concatenate([slopes, before, own, after], axis=2)
        found.append(_Linear(missed, slopes, rows, own))
    return found


def load_score_covariance(runs: Sequence[LoopModel], information: Sequence[Array]) -> Array:
    """Return the first-order covariance (q, q) of the scores T^T J^T r due to errors of the loads.

    information: T^T J^T J (q, p) of each run, with the Jacobian J of its residuals, and the units T
    of the scores (see `_units`). Runs that state the same load with the same standard deviations
    share its error. Errors of different loads are independent.
    """
    shown: dict[tuple[float, ...], Array] = {}
    for run, one in zip(runs, information, strict=True):
        load = (*run.payload, *run.payload_errors.ravel())
        shown[load] = shown.get(load, np.zeros_like(one)) + one
    by_errors = [
        total @ np.array(load[total.shape[1] :]).reshape(total.shape[1], -1)
        for load, total in shown.items()
    ]
    return np.asarray(sum(one @ one.T for one in by_errors), dtype=float)


def _units(rows: list[Array]) -> Array:
    """Return a matrix T (p, p) with T^T W T = 1, and so W^-1 = T T^T.

    W is the information of all rows (n, p) together. T is computed from the rows by QR, because W
    has the square of their condition number. For a record that contradicts the model, W could
    not be inverted accurately.
    """
    triangle = triangular_factor(np.vstack(rows))
    return np.asarray(solve_triangular(triangle, np.eye(triangle.shape[1])))


def _information(jacobian: Array) -> Array:
    """Return J^T J (p, p) of rows (..., p)."""
    rows = jacobian.reshape(-1, jacobian.shape[-1])
    return np.asarray(rows.T @ rows, dtype=float)


def _noise(
    problem: OutputErrorProblem,
    parameters: Array,
    found: list[_Linear],
    rng: np.random.Generator,
    advance: Advance,
) -> tuple[Array, Misfit, int]:
    """Return the covariance (q, q) of the scores due to noise, and the misfit.

    The third result is the number of unstable repetitions. found: linearisation of each run, with
    rows in the units of the scores. If logged commands drive all models, the residuals of noise
    alone are white, and no experiment is repeated. Residuals of the record can be so large that the
    model's error decides. Those of noise then count as white, if the first repetitions confirm this
    or fewer than FEWEST are stable. Otherwise, raises EstimationError for fewer than FEWEST.
    """
    runs = zip(problem.runs, found, strict=True)
    white = misfit_of_white(np.concatenate([run.without_common(one.missed) for run, one in runs]))
    as_white = np.asarray(sum(_information(one.rows) for one in found))
    if all(run.driven for run in problem.runs):
        advance(DRAWS)
        return as_white, white, 0
    # Each draw has its own generator, so results do not depend on the order of threads.
    draws = rng.spawn(DRAWS)
    results: list[tuple[Array, float]] = []
    if white.decides:
        # Noise alone can make residuals of this size where the servo amplifies it. A few
        # repetitions tell whether it does.
        results = _repeated(problem, parameters, found, draws[:LANES], advance)
        few = _misfit_of(white.found, results) if len(results) > 1 else white
        if few.decides and few.significant:
            advance(DRAWS - LANES)
            return as_white, few, 0
        draws = draws[LANES:]
    results += _repeated(problem, parameters, found, draws, advance)
    unstable = DRAWS - len(results)
    if len(results) < FEWEST and white.decides:
        return as_white, white, 0
    if len(results) < FEWEST:
        raise EstimationError(
            f"{unstable} of {DRAWS} repeated experiments on the identified model ended in an "
            "unstable loop: the servo is unstable with the sensor's noise, and no interval can be "
            "given"
        )
    rows = np.concatenate([one.rows.reshape(-1, one.rows.shape[2]) for one in found])
    drawn = np.array([noise.ravel() for noise, _ in results]).reshape(len(results), len(rows))
    # A single product for all draws reads the rows only once.
    return np.cov((drawn @ rows).T), _misfit_of(white.found, results), unstable


def _misfit_of(found: float, repeated: Sequence[tuple[Array, float]]) -> Misfit:
    """Return the misfit of a mean squared residual among those of repeated experiments."""
    squares = [square for _, square in repeated]
    return Misfit(found, float(np.mean(squares)), float(np.std(squares, ddof=1)))


def _repeated(
    problem: OutputErrorProblem,
    parameters: Array,
    found: list[_Linear],
    generators: Sequence[np.random.Generator],
    advance: Advance,
) -> list[tuple[Array, float]]:
    """Return residuals (n, 6) and mean squared residual of each stable repeated experiment.

    The residuals are those of noise alone. The mean square is that of noise and random common
    errors, whitened for both. There is one experiment for each generator.
    """

    def judged(
        repeated: Sequence[ClosedLoopRun], draws: np.random.Generator
    ) -> tuple[Array, float]:
        noise = [
            one.missed + run.whiten(run.measured - repeat.measured)
            for run, one, repeat in zip(problem.runs, found, repeated, strict=True)
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
    batches = [generators[k : k + LANES] for k in range(0, len(generators), LANES)]
    for some in in_threads(repeat, batches):
        results += [result for result in some if result]
        advance(len(some))
    return results


def repeated_experiments(
    run: LoopModel, parameters: Array, draws: Sequence[np.random.Generator]
) -> list[ClosedLoopRun | LoopFailure]:
    """Repeat the experiment on the identified model, with noise from each generator.

    Lost measured poses are NaN. For an unstable run, its LoopFailure is returned.
    """
    root = np.linalg.cholesky(run.covariance).T
    noises = np.stack([rng.standard_normal(run.measured.shape) @ root for rng in draws])
    return run.simulate_repeats(parameters, noises)


def correlation_matrix(covariance: Array) -> Array:
    """Return the correlations (n, n) of a covariance (n, n) with positive variances."""
    std = np.sqrt(np.diag(covariance))
    correlations = np.asarray(covariance / np.outer(std, std), dtype=float)
    np.fill_diagonal(correlations, 1.0)
    return correlations


def strongest_pairs(correlations: Array, names: Sequence[str], count: int) -> list[dict[str, Any]]:
    """Return the `count` pairs with the largest absolute correlations (n, n), the largest first.

    Each pair has the entries first, second and correlation.
    """
    rows, columns = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(correlations[rows, columns]), kind="stable")[:count]
    return [
        {"first": names[i], "second": names[j], "correlation": float(correlations[i, j])}
        for i, j in zip(rows[order], columns[order], strict=True)
    ]
