"""Fits of candidates beside the causes that were selected before, and the choice of the best fit.

Columns tell what a candidate explains to first order. Where the best candidate, once fitted, leaves
some of the misfit, those that columns cannot tell from it are fitted, too. So is the first cause of
another group with trial sizes and a statistic close to the best, as its column is the least exact.
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

# Fraction of the best statistic above which a cause with trial sizes is fitted, too.
CLOSE = 0.8
LOOSE = 0.3  # the same fraction, where the best candidate as fitted leaves some of the misfit
# Fraction of the misfit: if all fits leave more, causes are fitted from their trial sizes.
MOST_LEFT = 0.2
# Smallest fraction of the misfit that the right causes explain. They leave only noise when fitted.
# Groups of many numbers can take up most of the effect of a cause outside the catalogue.
MOST_OF_IT = 0.9
# Largest number of candidates beside the best that are fitted or returned.
RIVALS = 3
# Fraction of the cost by which equally good fits can differ, as a fit never converges fully.
INEXACT = 1e-3


@dataclass(frozen=True)
class Selected:
    """Selected candidate.

    ranked  The candidate as it was ranked.
    places  Indices in the catalogue of those of its causes whose sizes chance does not explain.
    gain    Fall of the cost by its fit, and that of earlier candidates that it makes needless.
    alike   Names of the candidates that cannot be told apart from it.
    """

    ranked: Ranked
    places: tuple[int, ...]
    gain: float
    alike: tuple[str, ...]


@dataclass(frozen=True)
class State:
    """Selected candidates so far, their optimum, and what is asked there.

    places: indices of the fitted causes in the catalogue. causes: the catalogue with the causes as
    they were fitted. fresh: whether the columns are those at this optimum. ranking: candidates that
    remain.
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
    """Candidate that was fitted beside those selected before it.

    added: indices of its causes and their companions. places: indices of all causes that the fit
    has kept, in the order of the point's sizes.
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
    """Fit the best candidate of a state's ranking beside the causes that the state has.

    Others are fitted, too, see `CLOSE`, `LOOSE`, `RIVALS` and `MOST_LEFT`. Returns the fits that
    help, by increasing cost. The best candidate's leads if its cost is hardly above the least.
    """
    point, asked, places = now.point, now.asked, now.places
    alike = indistinguishable(now.ranking, rows, point.beside_all.part(point.residual))
    first = _trial(problem, point, asked, places, alike[0])
    leaves_misfit = first is not None and misfit_of(rows, first.point.residual).significant
    rival = _rival(asked.causes, alike[0], now.ranking, LOOSE if leaves_misfit else CLOSE)
    others = () if rival is None else (rival,)
    if leaves_misfit:
        others = (*others, *alike[1 : 1 + RIVALS])
    fits = [(alike[0], first)]
    reach = _of_use(now, first, rows)
    fits += [(one, _trial(problem, point, asked, places, one, reach)) for one in others]
    helping = [(one, fit) for one, fit in fits if fit is not None]
    least = min((fit.point.cost for _, fit in helping), default=point.cost)
    misfit = beyond_noise(rows, point.cost)
    # fits from trial sizes take too long beside a selection that explains little of the misfit
    useful = misfit <= MOST_LEFT * (misfit + sum(one.gain for one in now.chosen)) or not now.chosen
    if useful and beyond_noise(rows, least) > MOST_LEFT * misfit:
        helping += _from_afar(problem, now, rows, least, [one for one, _ in fits])
    if not helping:
        return ()
    helping.sort(key=lambda pair: pair[1].point.cost)
    least = helping[0][1].point.cost
    as_good = least + max(NEAR, INEXACT * least)
    if first is not None and first.point.cost <= as_good:
        helping = [(alike[0], first), *(pair for pair in helping if pair[0] is not alike[0])]
    lead = helping[0][0]
    # candidates whose fit fails or costs more can be told apart from the best
    apart = [id(one) for one, fit in fits if fit is None or fit.point.cost > as_good]
    if all(one is not lead for one in alike):
        alike = ()
    still_alike = tuple(one for one in alike if one is not lead and id(one) not in apart)
    best = Way(*helping[0], still_alike)
    return (best, *(Way(*pair, ()) for pair in helping[1 : 1 + RIVALS]))


def _of_use(now: State, first: FittedCandidate | None, rows: Rows) -> float:
    """Return the cost above which the fit of another candidate than the first is of no use.

    A useful fit is as good as the first. If nothing is selected yet, a fit that explains nearly all
    of the misfit is useful, too, as a selection can begin anew with it.
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
    """Fit causes from their trial sizes, whatever they explain to first order.

    The parameters can have taken up so much of such a cause that it shows only once they are fitted
    with it. least: cost of the best fit before. done: candidates that were fitted already, from the
    size at which they explain most. The largest size of a cause comes first. Returns the fits that
    cost less than `least`, and ends after one that leaves little of the misfit, see `MOST_LEFT`.
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
    before: Point,
    asked: Asked,
    places: tuple[int, ...],
    one: Ranked,
    reach: float = np.inf,
) -> FittedCandidate | None:
    """Fit a candidate beside the causes at `places`, or return None if the fit does not help.

    A fit helps if the cost falls by more than ln n and one of the new causes is kept. before:
    optimum with the causes at `places`. asked: causes as asked there. reach: cost above which a fit
    is of no use.
    """
    causes = asked.causes
    # some members of a group may have been fitted before
    new = [k for k, place in enumerate(one.candidate.places) if place not in places]
    own = tuple(one.candidate.places[k] for k in new)
    accompanying = companions(causes, own)
    added = (*own, *accompanying)
    zeros = np.zeros(len(accompanying))
    tried = [causes[place].tried[0] if causes[place].tried else 0.0 for place in own]
    sizes = np.concatenate([before.sizes, tried, zeros])
    expected = np.concatenate([before.sizes, one.score.sizes[new], zeros])
    linear = None
    if not any(tried):
        columns = np.hstack([before.columns, asked.columns[:, added]])
        linear = replace(before.linear, by_causes=columns)
    try:
        held = np.isin(np.arange(len(sizes)), len(before.sizes) + np.flatnonzero(tried))
        start, both = before.parameters, (*places, *added)
        kept, point = fitted(problem, start, causes, both, sizes, expected, held, linear, reach)
    except (DynamicsError, OutOfReachError):
        # the model with the cause does not run, or does not come near the record
        return None
    enough = before.cost - point.cost > np.log(len(before.residual))
    return FittedCandidate(added, kept, point) if enough and set(added) & set(kept) else None


def _rival(
    causes: Sequence[Cause], best: Ranked, ranking: Sequence[Ranked], share: float
) -> Ranked | None:
    """Return a cause that may do better than the best candidate once it is fitted, or None.

    Its group is not the best one's. It has trial sizes, and over `share` of the best statistic.
    """
    for one in ranking:
        cause = causes[one.candidate.places[0]]
        close = one.score.statistic > share * best.score.statistic
        if cause.tried and close and cause.group != causes[best.candidate.places[0]].group:
            return one
    return None


def companions(causes: Sequence[Cause], places: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of the companions of the causes at `places`."""
    wanted = [causes[place].companion for place in places]
    return tuple(
        place for place, one in enumerate(causes) if any(one is companion for companion in wanted)
    )


def excluded(causes: Sequence[Cause], asked: tuple[int, ...], places: tuple[int, ...]) -> bool:
    """Tell whether an asked cause shares an exclusive group with one of those at `places`."""
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
    """Fit causes, then leave out those whose sizes chance explains, and fit the rest again.

    places (k,): indices of the causes in the catalogue. The other arguments are as for `fit`, with
    `reach` for the first fit only. Returns the indices of the causes that are kept, and the optimum
    with them. If none is kept, it is the optimum with all. Raises the errors of `fit`.
    """
    own = [causes[place] for place in places]
    point = fit(problem, parameters, own, sizes, expected, held, linear, reach)
    kept = shown_sizes(point)
    remaining = tuple(np.array(places)[kept].tolist())
    if kept.all() or not kept.any():
        return remaining, point
    # chance may explain more of the causes that are kept, once the others are gone
    sizes = point.sizes[kept]
    none_held = np.zeros(len(remaining), dtype=bool)
    catalogue = with_fitted(causes, places, point.causes)
    kept_linear = replace(point.linear, by_causes=point.columns[:, kept])
    there = [catalogue[place] for place in remaining]
    linear = with_last_columns(problem, point.parameters, there, sizes, kept_linear)
    return fitted(problem, point.parameters, catalogue, remaining, sizes, sizes, none_held, linear)


def shown_sizes(point: Point) -> NDArray[np.bool_]:
    """Tell which sizes (k,) of an optimum are worth a number of their own.

    Backward elimination: the least significant size is left out while that raises the cost by less
    than ln n. Sizes without a variance stay.
    """
    found = point.score()
    limit = np.log(len(point.residual))
    kept = np.ones(len(point.sizes), dtype=bool)
    # Causes with trial sizes stay: no derivative tells what remains without them. So do those that
    # are there or not, which have a trial size, too.
    stays = np.array([bool(one.tried) for one in point.causes], dtype=bool)
    covariance = found.covariance()
    sizes = point.sizes.copy()
    while kept.any():
        inside = np.flatnonzero(kept)
        variances = np.diag(covariance)[inside]
        rises = np.where(
            (variances > 0) & ~stays[inside],
            sizes[inside] ** 2 / np.maximum(variances, 1e-300),
            np.inf,
        )
        least = inside[int(np.argmin(rises))]
        if rises.min() >= limit:
            break
        # the other sizes move to their optimum without it
        gain = covariance[:, least] / covariance[least, least]
        sizes = sizes - gain * sizes[least]
        covariance = covariance - np.outer(gain, covariance[least])
        kept[least] = False
    return kept


def with_fitted(
    causes: Sequence[Cause], places: tuple[int, ...], fitted: Sequence[Cause]
) -> tuple[Cause, ...]:
    """Return the causes, with those at `places` as they were fitted."""
    known = dict(zip(places, fitted, strict=True))
    return tuple(known.get(place, one) for place, one in enumerate(causes))
