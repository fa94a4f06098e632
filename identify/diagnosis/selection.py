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
from identify.diagnosis.asking import Asked, ask
from identify.diagnosis.cause import Cause
from identify.diagnosis.fit import Point, fit
from identify.diagnosis.linearisation import Linearisation
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
from identify.estimation.explanation import Misfit
from identify.estimation.output_error import OutputErrorProblem

CHANCE = 0.01
"""Probability that a right model is accused of any cause in the catalogue."""

MOST = 3
"""Largest number of causes or groups that are selected."""

CLOSE = 0.8
"""Share of the best statistic from which on a cause that is tried at a size is fitted, too."""

LOOSE = 0.3
"""The same share, where the best candidate leaves some of the misfit when it is fitted."""

RIVALS = 3
"""Largest number of candidates beside the best that are fitted, as columns cannot tell them apart.
"""

INEXACT = 1e-3
"""Share of a fitted cost by which two fits can differ, as each follows the motion only so far."""


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
class State:
    """Selected candidates so far, their optimum, and what is asked there.

    places: those of the fitted causes in the catalogue. causes: the catalogue with the causes as
    they were fitted. fresh: whether columns are those at this optimum. ranking: of the candidates
    that are left.
    """

    chosen: tuple[Selected, ...]
    places: tuple[int, ...]
    point: Point
    causes: tuple[Cause, ...]
    asked: Asked
    ranking: tuple[Ranked, ...]
    fresh: bool = True


def select(
    problem: OutputErrorProblem, point: Point, causes: Sequence[Cause], asked: Asked
) -> Selection:
    """Select the causes that explain the misfit of a problem at its optimum.

    point: optimum without any cause. asked: causes there.
    """
    rows = Rows.of(problem, point.residual)
    first = rank(asked.causes, asked.columns, point.residual, point.beside, rows)
    now = State((), (), point, tuple(causes), asked, first)
    while len(now.chosen) < MOST:
        more = _with_next(problem, now, point.cost, rows)
        if more is None:
            break
        now = _exchanged(problem, more, point.cost, rows) if more.fresh else more
    before, after = (misfit_of(rows, one.residual) for one in (point, now.point))
    return Selection(now.chosen, now.places, now.point, first, before, after)


def _with_next(problem: OutputErrorProblem, now: State, cost: float, rows: Rows) -> State | None:
    """Return the state with the best of the candidates that are left, or None if none counts.

    cost: that without any cause.
    """
    if not now.ranking or now.ranking[0].chance > CHANCE:
        return None
    # columns follow what was fitted only so far, and those that are not new less
    followed = 1 - (EXACT if now.fresh else ALIKE) ** 2
    if now.ranking[0].score.statistic < followed * (cost - now.point.cost):
        return None
    trial, alike = _best_fitted(problem, now, rows)
    if trial is None:
        return None
    names = tuple(one.candidate.name for one in alike[1:])
    one = Selected(alike[0], trial.added, now.point.cost - trial.point.cost, names)
    chosen = _of_places((*now.chosen, one), trial.places)
    return _state(problem, now, chosen, trial.places, trial.point, rows)


def _state(
    problem: OutputErrorProblem,
    before: State,
    chosen: tuple[Selected, ...],
    places: tuple[int, ...],
    point: Point,
    rows: Rows,
    left_out: tuple[int, ...] = (),
) -> State:
    """Return the state at an optimum with the causes at some places.

    All are asked anew while noise does not explain what is left. left_out: places of causes that
    are not asked.
    """
    causes = _with_fitted(before.causes, places, point.causes)
    fresh = misfit_of(rows, point.residual).significant
    if fresh:
        asked = ask(problem, point, causes, places)
    else:
        asked = replace(
            before.asked, causes=_with_fitted(before.asked.causes, places, point.causes)
        )
    ranking = tuple(
        one
        for one in rank(asked.causes, asked.columns, point.residual, point.beside_all, rows)
        if not set(one.candidate.places) <= {*places, *left_out}
        and not _excluded(causes, one.candidate.places, places)
    )
    return State(chosen, places, point, causes, asked, ranking, fresh)


def _exchanged(problem: OutputErrorProblem, now: State, cost: float, rows: Rows) -> State:
    """Return a state with another cause in place of one that is there or not, if that is better.

    Such a cause has no size that could become insignificant. It can take up what several causes
    make together, and is asked again once one of these is fitted. cost: that without any cause.
    """
    for one in now.chosen[:-1]:
        if all(now.causes[place].step for place in one.places):
            continue
        stay = [k for k, place in enumerate(now.places) if place not in one.places]
        sizes = now.point.sizes[stay]
        places = tuple(now.places[k] for k in stay)
        free = np.zeros(len(stay), dtype=bool)
        start = now.point.parameters
        try:
            fitted = _fitted(problem, start, now.causes, places, sizes, sizes, free, None)
        except DynamicsError:
            continue
        others = tuple(other for other in now.chosen if other is not one)
        without = _state(problem, now, _of_places(others, fitted[0]), *fitted, rows, one.places)
        found = _with_next(problem, without, cost, rows)
        if found and found.point.cost < now.point.cost - max(NEAR, INEXACT * now.point.cost):
            *kept, last = found.chosen
            gain = cost - found.point.cost - sum(other.gain for other in kept)
            return replace(found, chosen=(*kept, replace(last, gain=gain)))
    return now


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


def _best_fitted(
    problem: OutputErrorProblem, now: State, rows: Rows
) -> tuple[FittedCandidate | None, tuple[Ranked, ...]]:
    """Fit the best candidate of a state's ranking beside the causes that it has.

    Where that leaves some of the misfit, others that columns cannot tell from it are fitted, too.
    Returns the best fit, or None where none helps, and its candidate with all like it.
    """
    point, asked, places = now.point, now.asked, now.places
    alike = indistinguishable(now.ranking, rows, point.beside_all.part(point.residual))
    first = _trial(problem, point, asked, places, alike[0])
    leaves = first is not None and misfit_of(rows, first.point.residual).significant
    rival = _rival(asked.causes, alike[0], now.ranking, LOOSE if leaves else CLOSE)
    others = () if rival is None else (rival,)
    if leaves:
        others = (*others, *alike[1 : 1 + RIVALS])
    fits = [(alike[0], first)]
    fits += [(one, _trial(problem, point, asked, places, one)) for one in others]
    helping = [(one, fit) for one, fit in fits if fit is not None]
    if not helping:
        return None, alike
    lead, best = min(helping, key=lambda pair: pair[1].point.cost)
    near = best.point.cost + max(NEAR, INEXACT * best.point.cost)
    if first is not None and first.point.cost <= near:
        lead, best = alike[0], first
    # fitted, the others can be told apart
    apart = [id(one) for one, fit in fits if fit is None or fit.point.cost > near]
    if lead is rival:
        alike = ()
    return best, (lead, *(one for one in alike if one is not lead and id(one) not in apart))


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


def _rival(
    causes: Sequence[Cause], best: Ranked, ranking: Sequence[Ranked], share: float
) -> Ranked | None:
    """Return a cause that may do better than the best candidate once it is fitted, or None.

    The statistic of one that is tried at a size is the roughest, and at least a share of the best.
    """
    for one in ranking:
        cause = causes[one.candidate.places[0]]
        close = one.score.statistic > share * best.score.statistic
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
