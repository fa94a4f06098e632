"""Forward selection: the cause that explains most is fitted, then the next one is asked.

Candidates are all causes alone, and all causes of a group together. They are ranked by their score
statistic S less d ln n, with d the degrees of freedom and n the number of residuals (Schwarz's
criterion), so that a group comes first only where one of its members does not do.

A candidate is accepted if chance does not make its statistic. What of the misfit it leaves is no
noise: it lasts from frame to frame, and goes together with any slow column. So the spread of U^T r
is that of noise and, by the share of the model's error, that of residuals as correlated as those
left (`identify.estimation.explanation`). The probability is multiplied by the number of candidates
(Bonferroni).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from dynamics import DynamicsError
from identify.arrays import Array
from identify.diagnosis.cause import Cause
from identify.diagnosis.fit import Point, fit
from identify.diagnosis.score import Beside, Score, score
from identify.estimation.explanation import Misfit, coloured_score_covariance, misfit_of_white
from identify.estimation.output_error import OutputErrorProblem

CHANCE = 0.01
"""Probability that a right model is accused of any cause in the catalogue."""

MOST = 4
"""Largest number of causes or groups that are selected."""

ALIKE = 0.99
"""Size of the cosine between two projected columns from which on they cannot be told apart."""

NEAR = 9.0
"""Difference of two statistics that chance may make, in units of the noise."""


@dataclass(frozen=True)
class Candidate:
    """One cause, or all causes of a group. places: theirs in the catalogue."""

    name: str
    places: tuple[int, ...]

    def shares(self, other: "Candidate") -> bool:
        """Tell whether two candidates have a cause in common."""
        return not set(self.places).isdisjoint(other.places)


def candidates(causes: Sequence[Cause]) -> tuple[Candidate, ...]:
    """Return all causes alone, then all groups that have several members."""
    groups: dict[str, list[int]] = {}
    for place, one in enumerate(causes):
        groups.setdefault(one.group, []).append(place)
    alone = (Candidate(one.name, (place,)) for place, one in enumerate(causes))
    together = (
        Candidate(name, tuple(places)) for name, places in groups.items() if len(places) > 1
    )
    return (*alone, *together)


@dataclass(frozen=True)
class Ranked:
    """Candidate with its score.

    chance: probability that a right model has such a statistic for any candidate. worth: the
    statistic less what as many free numbers gain by chance.
    """

    candidate: Candidate
    score: Score
    chance: float
    worth: float


@dataclass(frozen=True)
class Selected:
    """Selected candidate.

    Attributes
    ----------
    ranked : Ranked
        The candidate as it was ranked.
    places : tuple of int
        Places of those of its causes whose sizes chance does not explain.
    gain : float
        Fall of the cost as it was fitted.
    alike : tuple of str
        Names of the candidates that cannot be told apart from it.
    """

    ranked: Ranked
    places: tuple[int, ...]
    gain: float
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Selection:
    """Selected candidates, and the optimum with all of them.

    places: those of the fitted causes in the catalogue, in the order of the point's sizes.
    ranking: all candidates as ranked at first. before, after: misfit without and with the causes.
    """

    selected: tuple[Selected, ...]
    places: tuple[int, ...]
    point: Point
    ranking: tuple[Ranked, ...]
    before: Misfit
    after: Misfit


@dataclass(frozen=True)
class Rows:
    """Places of a problem's residuals in their vector (m,).

    known: number of rows for what is known beside the poses. frames: which frames (N,) of each run
    are good.
    """

    known: int
    frames: tuple[NDArray[np.bool_], ...]

    @classmethod
    def of(cls, problem: OutputErrorProblem, residual: Array) -> "Rows":
        """Return the places of residuals (m,) of a problem."""
        frames = tuple(run.ok for run in problem.runs)
        return cls(len(residual) - 6 * sum(int(one.sum()) for one in frames), frames)

    def of_poses(self, rows: Array) -> Array:
        """Return the part of residuals (m, ...) that is of poses."""
        return rows[self.known :]

    def spread(self, residual: Array, directions: Array) -> Array:
        """Return the covariance (d, d) of U^T r for residuals as correlated as r (m,).

        directions (m, d): the columns of U.
        """
        total = np.zeros((directions.shape[1],) * 2)
        first = self.known
        for ok in self.frames:
            own = slice(first, first + 6 * int(ok.sum()))
            first = own.stop
            rows = directions[own].reshape(-1, 6, directions.shape[1])
            total += coloured_score_covariance(residual[own].reshape(-1, 6), rows, ok)
        return total


def misfit_of(rows: Rows, residual: Array) -> Misfit:
    """Return the misfit of the poses in residuals (m,)."""
    return misfit_of_white(rows.of_poses(residual))


def rank(
    causes: Sequence[Cause], columns: Array, residual: Array, beside: Beside, rows: Rows
) -> tuple[Ranked, ...]:
    """Rank all candidates, the one of most worth first.

    columns (m, k) of the causes and the residual (m,) are not projected yet.
    """
    left = beside.part(residual)
    usable = np.isfinite(columns).all(axis=0)
    projected = beside.part(np.where(usable, columns, 0.0))
    lengths = np.where(usable, np.linalg.norm(columns, axis=0), np.inf)
    every = candidates(causes)
    count = len(rows.of_poses(residual))
    ranked = []
    for one in every:
        places = list(one.places)
        found = score(projected[:, places], left, lengths[places])
        chance = min(1.0, len(every) * chance_of(found, left, rows))
        ranked.append(Ranked(one, found, chance, found.statistic - found.freedoms * np.log(count)))
    return tuple(sorted(ranked, key=lambda one: -one.worth))


def chance_of(found: Score, residual: Array, rows: Rows) -> float:
    """Return the probability that a model without the causes has such a statistic.

    residual (m,): the one that was projected.
    """
    if not found.freedoms:
        return 1.0
    along = found.directions.T @ residual
    left = residual - found.directions @ along
    share = misfit_of(rows, left).share_of_model
    spread = np.eye(found.freedoms)
    if share:
        spread = spread + share * rows.spread(left, found.directions)
    return float(chdtrc(found.freedoms, along @ np.linalg.solve(spread, along)))


def alike(first: Ranked, ranking: Sequence[Ranked], noise: float) -> tuple[str, ...]:
    """Return the names of the candidates that cannot be told apart from the first one.

    They have no cause in common with it and no more freedoms, and explain as much but for chance.
    noise: mean squared residual that is left.
    """
    margin = max(NEAR * max(noise, 1.0), (1 - ALIKE**2) * first.score.statistic)
    return tuple(
        one.candidate.name
        for one in ranking
        if not one.candidate.shares(first.candidate)
        and 0 < one.score.freedoms <= first.score.freedoms
        and one.score.statistic >= first.score.statistic - margin
    )


def select(problem: OutputErrorProblem, point: Point, causes: Sequence[Cause]) -> Selection:
    """Select the causes that explain the misfit of a problem at its optimum.

    point: optimum with the columns of all causes, none of which has a size.
    """
    rows = Rows.of(problem, point.residual)
    first = rank(causes, point.columns, point.residual, point.beside, rows)
    nothing = replace(point, sizes=np.zeros(0), columns=point.columns[:, :0])
    chosen: tuple[Selected, ...] = ()
    places: tuple[int, ...] = ()
    now = nothing
    ranking = first
    while len(chosen) < MOST and ranking and ranking[0].chance <= CHANCE:
        best = ranking[0]
        # a group may be asked after one of its members
        new = [k for k, place in enumerate(best.candidate.places) if place not in places]
        added = tuple(best.candidate.places[k] for k in new)
        sizes = np.concatenate([now.sizes, best.score.sizes[new]])
        columns = np.hstack([now.columns, point.columns[:, added]])
        try:
            kept, fitted = _fitted(
                problem, now.parameters, causes, (*places, *added), sizes, columns
            )
        except DynamicsError:
            # the model with the cause does not run: no more can be said
            break
        noise = misfit_of(rows, fitted.residual).found
        one = Selected(best, added, now.cost - fitted.cost, alike(best, ranking, noise))
        chosen = _of_places((*chosen, one), kept)
        places = kept
        now = fitted
        ranking = tuple(
            one
            for one in rank(causes, point.columns, now.residual, now.beside_all, rows)
            if not set(one.candidate.places) <= set(places)
        )
    before, after = (misfit_of(rows, one.residual) for one in (point, now))
    return Selection(chosen, places, now, first, before, after)


def _fitted(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    places: tuple[int, ...],
    sizes: Array,
    columns: Array,
) -> tuple[tuple[int, ...], Point]:
    """Fit causes, and again without those that chance explains; return the places of the others.

    places (k,): those of the causes in the catalogue. Raises LoopFailure if the model is unstable.
    """
    point = fit(problem, parameters, tuple(causes[place] for place in places), sizes, columns)
    kept = shown_sizes(point)
    if kept.all() or not kept.any():
        return places, point
    left = tuple(np.array(places)[kept].tolist())
    # those that are left may be explained by others of them
    return _fitted(
        problem, point.parameters, causes, left, point.sizes[kept], point.columns[:, kept]
    )


def shown_sizes(point: Point) -> NDArray[np.bool_]:
    """Tell which sizes (k,) of an optimum are worth a number of their own.

    Backward elimination: the least significant one is left out while it lowers the cost by less
    than ln n.
    """
    there = point.score()
    limit = np.log(len(point.residual))
    kept = np.ones(len(point.sizes), dtype=bool)
    covariance = there.covariance()
    sizes = point.sizes.copy()
    while kept.sum() > 1:
        inside = np.flatnonzero(kept)
        falls = sizes[inside] ** 2 / np.diag(covariance)[inside]
        least = inside[int(np.argmin(falls))]
        if falls.min() >= limit:
            break
        # the others move to where they are best without it
        gain = covariance[:, least] / covariance[least, least]
        sizes = sizes - gain * sizes[least]
        covariance = covariance - np.outer(gain, covariance[least])
        kept[least] = False
    return kept


def _of_places(chosen: tuple[Selected, ...], places: tuple[int, ...]) -> tuple[Selected, ...]:
    """Return selected candidates with those of their causes alone that have these places."""
    inside = [
        replace(one, places=tuple(place for place in one.places if place in places))
        for one in chosen
    ]
    return tuple(one for one in inside if one.places)
