"""Fits of candidates beside the causes that were selected before, and which of them is the best.

Columns tell what a candidate explains to first order. Where they cannot tell candidates apart, or
where the best one leaves some of the misfit, several are fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynamics import DynamicsError
from identify.arrays import Array
from identify.diagnosis.asking import Asked
from identify.diagnosis.cause import Cause
from identify.diagnosis.fit import OutOfReachError, Point, fit, with_last_columns
from identify.diagnosis.linearisation import Linearisation
from identify.diagnosis.ranking import NEAR, Ranked, Rows, indistinguishable, misfit_of
from identify.estimation.output_error_problem import OutputErrorProblem

# Share of the best statistic from which on a cause that is tried at a size is fitted, too.
CLOSE = 0.8
LOOSE = 0.3  # the same share, where the best candidate leaves some of the misfit when it is fitted
# Share of a misfit which, if the best candidate leaves more, lets others be fitted from afar.
MOST_LEFT = 0.2
# Share of the misfit that the causes must explain for it to count as explained. A cause that is
# there leaves noise once it is fitted. Groups of many numbers can take up most of the effect of a
# cause outside the catalogue.
MOST_OF_IT = 0.9
# Largest number of candidates beside the best that are fitted, as columns cannot tell them apart.
RIVALS = 3
# Share of a fitted cost by which two fits can differ, as each follows the motion only so far.
INEXACT = 1e-3


@dataclass(frozen=True)
class Selected:
    """Selected candidate.

    ranked  The candidate as it was ranked.
    places  Places of those of its causes whose sizes chance does not explain.
    gain    Fall of the cost as it was fitted.
    alike   Names of the candidates that cannot be told apart from it.
    """

    ranked: Ranked
    places: tuple[int, ...]
    gain: float
    alike: tuple[str, ...]


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


@dataclass(frozen=True)
class FittedCandidate:
    """Candidate that was fitted beside those before it.

    added: places of its causes. places: those of all causes that are left, in the order of the
    point's sizes.
    """

    added: tuple[int, ...]
    places: tuple[int, ...]
    point: Point


@dataclass(frozen=True)
class Way:
    """Fitted candidate, and those that neither columns nor fits can tell from it."""

    candidate: Ranked
    fit: FittedCandidate
    alike: tuple[Ranked, ...]


def fitted_candidates(problem: OutputErrorProblem, now: State, rows: Rows) -> tuple[Way, ...]:
    """Fit the best candidate of a state's ranking beside the causes that it has.

    Where that leaves some of the misfit, others that columns cannot tell from it are fitted, too,
    and where all leave most of it, those that are tried at sizes. Returns the fits that help, the
    best first, and the others by their costs.
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
    reach = _of_use(now, first, rows)
    fits += [(one, _trial(problem, point, asked, places, one, reach)) for one in others]
    helping = [(one, fit) for one, fit in fits if fit is not None]
    least = min((fit.point.cost for _, fit in helping), default=point.cost)
    left = beyond_noise(rows, point.cost)
    # a selection that explains little of the misfit is not worth more of these fits
    known = left <= MOST_LEFT * (left + sum(one.gain for one in now.chosen)) or not now.chosen
    if known and beyond_noise(rows, least) > MOST_LEFT * left:
        helping += _from_afar(problem, now, rows, least, [one for one, _ in fits])
    if not helping:
        return ()
    helping.sort(key=lambda pair: pair[1].point.cost)
    least = helping[0][1].point.cost
    near = least + max(NEAR, INEXACT * least)
    if first is not None and first.point.cost <= near:
        helping = [(alike[0], first), *(pair for pair in helping if pair[0] is not alike[0])]
    lead = helping[0][0]
    # fitted, the others can be told apart
    apart = [id(one) for one, fit in fits if fit is None or fit.point.cost > near]
    if all(one is not lead for one in alike):
        alike = ()
    like = tuple(one for one in alike if one is not lead and id(one) not in apart)
    best = Way(*helping[0], like)
    return (best, *(Way(*pair, ()) for pair in helping[1 : 1 + RIVALS]))


def _of_use(now: State, first: FittedCandidate | None, rows: Rows) -> float:
    """Return the cost above which the fit of another candidate than the first is of no use.

    It must be as good as the first, or be a cause with which a selection can begin anew.
    """
    if first is None:
        return np.inf
    near = first.point.cost + max(NEAR, INEXACT * first.point.cost)
    if now.chosen:
        return near
    return max(near, rows.count + (1 - MOST_OF_IT) * beyond_noise(rows, now.point.cost))


def beyond_noise(rows: Rows, cost: float) -> float:
    """Return the part of a cost that noise does not explain."""
    return max(cost - rows.count, 0.0)


def _from_afar(
    problem: OutputErrorProblem,
    now: State,
    rows: Rows,
    least: float,
    done: Sequence[Ranked],
) -> list[tuple[Ranked, FittedCandidate]]:
    """Fit causes from the sizes at which they are tried, whatever they explain to first order.

    Where no candidate explains most, the parameters can have taken up so much of such a cause that
    it shows only once they follow. least: cost of the best fit so far. done: candidates that were
    fitted from the size at which they explain most. Of the sizes of a cause, the largest comes
    first, and those after one that explains most are left out.
    """
    found = []
    for one in now.ranking:
        place = one.candidate.places[0]
        cause = now.causes[place]
        if len(one.candidate.places) > 1 or not cause.tried:
            continue
        left_out = now.asked.causes[place].tried if any(one is other for other in done) else ()
        for size in reversed([size for size in cause.tried if size not in left_out]):
            causes = list(now.asked.causes)
            causes[place] = replace(cause, tried=(size,))
            asked = replace(now.asked, causes=tuple(causes))
            fit = _trial(problem, now.point, asked, now.places, one, least)
            if fit is None or fit.point.cost >= least:
                continue
            found.append((one, fit))
            left = beyond_noise(rows, fit.point.cost)
            if left < MOST_LEFT * beyond_noise(rows, least):
                return found
    return found


def _trial(
    problem: OutputErrorProblem,
    now: Point,
    asked: Asked,
    places: tuple[int, ...],
    best: Ranked,
    reach: float = np.inf,
) -> FittedCandidate | None:
    """Fit a candidate beside the causes at some places, or return None where that does not help.

    now: optimum with those at places. asked: causes there. reach: cost above which the fit is of no
    use.
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
        kept, point = fitted(
            problem, now.parameters, causes, (*places, *added), sizes, expected, held, linear, reach
        )
    except (DynamicsError, OutOfReachError):
        # the model with the cause does not run, or does not come near the record
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


def excluded(causes: Sequence[Cause], asked: tuple[int, ...], places: tuple[int, ...]) -> bool:
    """Tell whether causes at asked places cannot be there beside those at other places."""
    taken = {causes[place].group for place in places if causes[place].exclusive}
    return any(causes[place].group in taken for place in asked)


def fitted(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    places: tuple[int, ...],
    sizes: Array,
    expected: Array,
    held: NDArray[np.bool_],
    linear: Linearisation | None,
    reach: float = np.inf,
) -> tuple[tuple[int, ...], Point]:
    """Fit causes, and again without those that chance explains; return the places of the others.

    places (k,): those of the causes in the catalogue. reach: cost above which the first fit is of
    no use. Raises LoopFailure if the model is unstable, and the OutOfReachError of `fit`.
    """
    own = [causes[place] for place in places]
    point = fit(problem, parameters, own, sizes, expected, held, linear, reach)
    kept = shown_sizes(point)
    left = tuple(np.array(places)[kept].tolist())
    if kept.all() or not kept.any():
        return left, point
    # those that are left may be explained by others of them
    sizes = point.sizes[kept]
    free = np.zeros(len(left), dtype=bool)
    known = with_fitted(causes, places, point.causes)
    last = replace(point.linear, by_causes=point.columns[:, kept])
    there = [known[place] for place in left]
    linear = with_last_columns(problem, point.parameters, there, sizes, last)
    return fitted(problem, point.parameters, known, left, sizes, sizes, free, linear)


def shown_sizes(point: Point) -> NDArray[np.bool_]:
    """Tell which sizes (k,) of an optimum are worth a number of their own.

    Backward elimination: the least significant one is left out while it lowers the cost by less
    than ln n.
    """
    there = point.score()
    limit = np.log(len(point.residual))
    kept = np.ones(len(point.sizes), dtype=bool)
    # One that is there or not has no size that could be left out. One that is tried at a size has
    # no derivative that tells what is left without it.
    lasting = np.array([bool(one.tried) for one in point.causes], dtype=bool)
    covariance = there.covariance()
    sizes = point.sizes.copy()
    while kept.any():
        inside = np.flatnonzero(kept)
        variances = np.diag(covariance)[inside]
        falls = np.where(
            (variances > 0) & ~lasting[inside],
            sizes[inside] ** 2 / np.maximum(variances, 1e-300),
            np.inf,
        )
        least = inside[int(np.argmin(falls))]
        if falls.min() >= limit:
            break
        # the others move to where they are best without it
        gain = covariance[:, least] / covariance[least, least]
        sizes = sizes - gain * sizes[least]
        covariance = covariance - np.outer(gain, covariance[least])
        kept[least] = False
    return kept


def with_fitted(
    causes: Sequence[Cause], places: tuple[int, ...], fitted: Sequence[Cause]
) -> tuple[Cause, ...]:
    """Return causes, those at some places as they were fitted."""
    known = dict(zip(places, fitted, strict=True))
    return tuple(known.get(place, one) for place, one in enumerate(causes))
