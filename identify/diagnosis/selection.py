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
from identify.diagnosis.cause import Cause
from identify.diagnosis.fit import Point, fit
from identify.diagnosis.ranking import ALIKE, NEAR, Ranked, Rows, indistinguishable, misfit_of, rank
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
        # columns are those without any cause, and follow what was fitted only so far
        if ranking[0].score.statistic < (1 - ALIKE**2) * (point.cost - now.cost):
            break
        alike = indistinguishable(ranking, rows, now.beside_all.part(now.residual))
        best = alike[0]
        trial = _trial(problem, point, now, causes, places, best)
        rival = _rival(causes, best, ranking)
        other = rival and _trial(problem, point, now, causes, places, rival)
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
        ranking = tuple(
            one
            for one in rank(causes, point.columns, now.residual, now.beside_all, rows)
            if not set(one.candidate.places) <= set(places)
            and not _excluded(causes, one.candidate.places, places)
        )
    before, after = (misfit_of(rows, one.residual) for one in (point, now))
    return Selection(chosen, places, now, first, before, after)


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
    problem: OutputErrorProblem,
    first: Point,
    now: Point,
    causes: Sequence[Cause],
    places: tuple[int, ...],
    best: Ranked,
) -> FittedCandidate | None:
    """Fit a candidate beside the causes at some places, or return None where that does not help.

    first: optimum without any cause, with the columns of all. now: optimum with those at places.
    """
    # a group may be asked after one of its members
    new = [k for k, place in enumerate(best.candidate.places) if place not in places]
    own = tuple(best.candidate.places[k] for k in new)
    beside = companions(causes, own)
    added = (*own, *beside)
    # a column that was tried at a size is exact there
    starts = [
        causes[place].tried[:1] or best.score.sizes[[k]] for k, place in zip(new, own, strict=True)
    ]
    sizes = np.concatenate([now.sizes, *starts, np.zeros(len(beside))])
    columns = np.hstack([now.columns, first.columns[:, added]])
    try:
        kept, point = _fitted(problem, now.parameters, causes, (*places, *added), sizes, columns)
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
    columns: Array,
) -> tuple[tuple[int, ...], Point]:
    """Fit causes, and again without those that chance explains; return the places of the others.

    places (k,): those of the causes in the catalogue. Raises LoopFailure if the model is unstable.
    """
    point = fit(problem, parameters, tuple(causes[place] for place in places), sizes, columns)
    kept = shown_sizes(point)
    if kept.all() or not kept.any():
        return tuple(np.array(places)[kept].tolist()), point
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
