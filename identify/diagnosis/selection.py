"""Forward selection: the cause that explains most is fitted, then the next one is asked.

Causes that were selected before stay free beside the parameters. Of all that are fitted, those
whose sizes chance explains are left out again (backward elimination).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynamics import DynamicsError
from identify.arrays import Array
from identify.diagnosis.cause import Cause, with_causes
from identify.diagnosis.fit import Point, fit
from identify.diagnosis.linearisation import Linearisation, each_residuals, linearisation
from identify.diagnosis.ranking import (
    ALIKE,
    EXACT,
    NEAR,
    Ranked,
    Rows,
    indistinguishable,
    misfit_of,
    rank,
)
from identify.diagnosis.score import score
from identify.estimation.explanation import Misfit
from identify.estimation.output_error import OutputErrorProblem

CHANCE = 0.01
"""Probability that a right model is accused of any cause in the catalogue."""

MOST = 3
"""Largest number of causes or groups that are selected."""

CLOSE = 0.8
"""Share of the best statistic from which on a cause that is tried at a size is fitted, too."""


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
class Asked:
    """Causes as they are asked at an optimum, and their columns (m, k) there.

    A cause that is tried at some sizes has the difference to the largest gain there as its column,
    by its size. It is returned with that size alone.
    """

    causes: tuple[Cause, ...]
    columns: Array


def ask(
    problem: OutputErrorProblem, point: Point, causes: Sequence[Cause], places: tuple[int, ...]
) -> Asked:
    """Return the causes at an optimum with those at some places fitted."""
    sizes = np.zeros(len(causes))
    sizes[list(places)] = point.sizes
    asked = to_ask(causes, places)
    columns = np.zeros((len(point.residual), len(causes)))
    columns[:, list(places)] = point.columns
    found = linearisation(problem, point.parameters, causes, sizes, asked)
    columns[:, asked] = found.by_causes
    return _tried(problem, point, causes, sizes, asked, columns)


def ask_first(
    problem: OutputErrorProblem,
    parameters: Array,
    at_bound: NDArray[np.bool_],
    causes: Sequence[Cause],
) -> tuple[Point, Asked]:
    """Return the optimum (p,) of a problem without any cause, and the causes there.

    at_bound (p,): coordinates of the parameters that are held at their bounds. One run of the model
    is differentiated for both.
    """
    sizes = np.zeros(len(causes))
    asked = to_ask(causes, ())
    found = linearisation(problem, parameters, causes, sizes, asked)
    alone = replace(found, by_causes=found.by_causes[:, :0])
    point = Point.of(problem, (), parameters, at_bound, sizes[:0], alone)
    columns = np.zeros((len(found.residual), len(causes)))
    columns[:, asked] = found.by_causes
    return point, _tried(problem, point, causes, sizes, asked, columns)


def to_ask(causes: Sequence[Cause], places: tuple[int, ...]) -> list[int]:
    """Return the places of causes that can be asked beside those at other places.

    A companion has no effect before its cause is there.
    """
    beside = [one.companion for one in causes if one.companion is not None]
    return [
        place
        for place, one in enumerate(causes)
        if place not in places and not any(one is companion for companion in beside)
    ]


def _tried(
    problem: OutputErrorProblem,
    point: Point,
    causes: Sequence[Cause],
    sizes: Array,
    asked: Sequence[int],
    columns: Array,
) -> Asked:
    """Return causes with columns (m, k), after those that are tried at some sizes.

    sizes (k,): those at the optimum. asked: places of the causes that are asked.
    """
    chosen = list(causes)
    left = point.beside_all.part(point.residual)
    there = with_causes(problem, causes, sizes)
    tried = [(place, size) for place in asked for size in causes[place].tried]
    ends = [causes[place].change(there, size) for place, size in tried]
    gains = np.zeros(len(causes))
    for (place, size), end in zip(tried, each_residuals(ends, point.parameters), strict=True):
        if end is None:
            continue
        column = ((end - point.residual) / size)[:, None]
        judged = score(point.beside_all.part(column), left, np.linalg.norm(column, axis=0))
        if judged.sizes[0] > 0 and judged.statistic > gains[place]:
            gains[place] = judged.statistic
            columns[:, place] = column[:, 0]
            chosen[place] = replace(causes[place], tried=(size,))
    return Asked(tuple(chosen), columns)


def select(
    problem: OutputErrorProblem, point: Point, causes: Sequence[Cause], asked: Asked
) -> Selection:
    """Select the causes that explain the misfit of a problem at its optimum.

    point: optimum without any cause. asked: causes there.
    """
    rows = Rows.of(problem, point.residual)
    first = rank(asked.causes, asked.columns, point.residual, point.beside, rows)
    chosen: tuple[Selected, ...] = ()
    places: tuple[int, ...] = ()
    now = point
    ranking = first
    catalogue = tuple(causes)
    fresh = True
    while len(chosen) < MOST and ranking and ranking[0].chance <= CHANCE:
        # columns follow what was fitted only so far, and those that are not new less
        followed = 1 - (EXACT if fresh else ALIKE) ** 2
        if ranking[0].score.statistic < followed * (point.cost - now.cost):
            break
        alike = indistinguishable(ranking, rows, now.beside_all.part(now.residual))
        best = alike[0]
        trial = _trial(problem, now, asked, places, best)
        rival = _rival(asked.causes, best, ranking)
        other = rival and _trial(problem, now, asked, places, rival)
        if rival and other and (trial is None or other.point.cost < trial.point.cost - NEAR):
            # fitted, the two can be told apart
            trial = other
            best = rival
            alike = (rival,)
        if trial is None:
            break
        names = tuple(one.candidate.name for one in alike[1:])
        one = Selected(best, trial.added, now.cost - trial.point.cost, names)
        places = trial.places
        chosen = _of_places((*chosen, one), places)
        now = trial.point
        catalogue = _with_fitted(catalogue, places, now.causes)
        fresh = misfit_of(rows, now.residual).significant
        if fresh:
            asked = ask(problem, now, catalogue, places)
        else:
            asked = replace(asked, causes=_with_fitted(asked.causes, places, now.causes))
        ranking = tuple(
            one
            for one in rank(asked.causes, asked.columns, now.residual, now.beside_all, rows)
            if not set(one.candidate.places) <= set(places)
            and not _excluded(causes, one.candidate.places, places)
        )
    before, after = (misfit_of(rows, one.residual) for one in (point, now))
    return Selection(chosen, places, now, first, before, after)


def _with_fitted(
    causes: Sequence[Cause], places: tuple[int, ...], fitted: Sequence[Cause]
) -> tuple[Cause, ...]:
    """Return causes, those at some places as they were fitted."""
    known = dict(zip(places, fitted, strict=True))
    return tuple(known.get(place, one) for place, one in enumerate(causes))


@dataclass(frozen=True)
class FittedCandidate:
    """Candidate that was fitted beside those before it.

    added: places of its causes. places: those of all causes that are left, in the order of the
    point's sizes.
    """

    added: tuple[int, ...]
    places: tuple[int, ...]
    point: Point


def _trial(
    problem: OutputErrorProblem, now: Point, asked: Asked, places: tuple[int, ...], best: Ranked
) -> FittedCandidate | None:
    """Fit a candidate beside the causes at some places, or return None where that does not help.

    now: optimum with those at places. asked: causes there.
    """
    causes = asked.causes
    # a group may be asked after one of its members
    new = [k for k, place in enumerate(best.candidate.places) if place not in places]
    own = tuple(best.candidate.places[k] for k in new)
    beside = companions(causes, own)
    added = (*own, *beside)
    none = np.zeros(len(beside))
    tried = [causes[place].tried[0] if causes[place].tried else 0.0 for place in own]
    sizes = np.concatenate([now.sizes, tried, none])
    expected = np.concatenate([now.sizes, best.score.sizes[new], none])
    linear = None
    if not any(tried):
        linear = replace(now.linear, by_causes=np.hstack([now.columns, asked.columns[:, added]]))
    try:
        held = np.isin(np.arange(len(sizes)), len(now.sizes) + np.flatnonzero(tried))
        kept, point = _fitted(
            problem, now.parameters, causes, (*places, *added), sizes, expected, held, linear
        )
    except DynamicsError:
        # the model with the cause does not run
        return None
    enough = now.cost - point.cost > np.log(len(now.residual))
    return FittedCandidate(added, kept, point) if enough and set(added) & set(kept) else None


def _rival(causes: Sequence[Cause], best: Ranked, ranking: Sequence[Ranked]) -> Ranked | None:
    """Return a cause that may do better than the best candidate once it is fitted, or None.

    The statistic of one that is tried at a size is the roughest.
    """
    for one in ranking:
        cause = causes[one.candidate.places[0]]
        close = one.score.statistic > CLOSE * best.score.statistic
        if cause.tried and close and cause.group != causes[best.candidate.places[0]].group:
            return one
    return None


def companions(causes: Sequence[Cause], places: tuple[int, ...]) -> tuple[int, ...]:
    """Return the places of the companions that causes at some places have."""
    wanted = [causes[place].companion for place in places]
    return tuple(
        place for place, one in enumerate(causes) if any(one is companion for companion in wanted)
    )


def _excluded(causes: Sequence[Cause], asked: tuple[int, ...], places: tuple[int, ...]) -> bool:
    """Tell whether causes at asked places cannot be there beside those at other places."""
    taken = {causes[place].group for place in places if causes[place].exclusive}
    return any(causes[place].group in taken for place in asked)


def _fitted(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    places: tuple[int, ...],
    sizes: Array,
    expected: Array,
    held: NDArray[np.bool_],
    linear: Linearisation | None,
) -> tuple[tuple[int, ...], Point]:
    """Fit causes, and again without those that chance explains; return the places of the others.

    places (k,): those of the causes in the catalogue. Raises LoopFailure if the model is unstable.
    """
    own = [causes[place] for place in places]
    point = fit(problem, parameters, own, sizes, expected, held, linear)
    kept = shown_sizes(point)
    left = tuple(np.array(places)[kept].tolist())
    if kept.all() or not kept.any():
        return left, point
    # those that are left may be explained by others of them
    sizes = point.sizes[kept]
    free = np.zeros(len(left), dtype=bool)
    fitted = _with_fitted(causes, places, point.causes)
    return _fitted(problem, point.parameters, fitted, left, sizes, sizes, free, None)


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
    while kept.any():
        inside = np.flatnonzero(kept)
        variances = np.diag(covariance)[inside]
        # a cause that is there or not has no size that could be left out
        falls = np.where(variances > 0, sizes[inside] ** 2 / np.maximum(variances, 1e-300), np.inf)
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
    """Return selected candidates with those of their causes alone that have these places.

    One that has none left has been explained by the last one, which takes over its gain.
    """
    inside = [
        replace(one, places=tuple(place for place in one.places if place in places))
        for one in chosen
    ]
    lost = sum(one.gain for one in inside if not one.places)
    *earlier, last = (one for one in inside if one.places)
    return (*earlier, replace(last, gain=last.gain + lost))
