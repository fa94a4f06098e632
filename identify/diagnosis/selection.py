"""Forward selection: the cause that explains most is fitted, then the next one is asked.

Causes that were selected before stay free beside the parameters. Of all that are fitted, those
whose sizes chance explains are left out again (backward elimination).

The first cause is chosen before those beside it are known. If several candidates each explain
nearly all, a wrong one can take up the effect of others. Where a selection needs many causes, or
leaves some of the misfit, it therefore begins anew with each of the others. The selection with the
least cost + k ln n for its k sizes counts (Schwarz's criterion).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from identify.diagnosis.asking import Asked, ask
from identify.diagnosis.candidate_fits import (
    INEXACT,
    MOST_OF_IT,
    RIVALS,
    Selected,
    State,
    Way,
    beyond_noise,
    excluded,
    fitted,
    fitted_candidates,
    with_fitted,
)
from identify.diagnosis.cause import Cause, with_causes
from identify.diagnosis.fit import Point
from identify.diagnosis.ranking import (
    ALIKE,
    EXACT,
    NEAR,
    Ranked,
    Rows,
    explained_by_all,
    misfit_of,
    rank,
)
from identify.diagnosis.score import score
from identify.estimation.explanation import Misfit
from identify.estimation.output_error_problem import OutputErrorProblem

CHANCE = 0.01  # largest probability of chance with which a candidate counts
MOST = 3  # largest number of causes or groups that are selected
SEVERAL = 2  # number of candidates above which a selection begins anew with another first one


@dataclass(frozen=True)
class Selection:
    """Selected candidates, and the optimum with all of them.

    places: indices of the fitted causes in the catalogue, in the order of the point's sizes.
    ranking: all candidates as ranked at first. before, after: misfit without and with the causes.
    """

    selected: tuple[Selected, ...]
    places: tuple[int, ...]
    point: Point
    ranking: tuple[Ranked, ...]
    before: Misfit
    after: Misfit


def select(
    problem: OutputErrorProblem, point: Point, causes: Sequence[Cause], asked: Asked
) -> Selection:
    """Select the causes that explain the misfit of a problem at its optimum.

    point: optimum without any cause. asked: causes as asked there.
    """
    rows = Rows.of(problem, point.residual)
    first = rank(asked.causes, asked.columns, point.residual, point.beside, rows)
    start = State((), (), point, tuple(causes), asked, first)
    ways = _next_fits(problem, start, rows)
    ended = start
    for attempt, one in enumerate(ways):
        if attempt and not (_explains_most(rows, point, one.fit.point) and _doubtful(rows, ended)):
            break
        found = _followed(problem, _with_fit(problem, start, one, rows), point.cost, rows)
        ended = found if not attempt or _criterion(found) < _criterion(ended) else ended
    ended = _simplified(problem, ended, rows)
    before, after = (misfit_of(rows, one.residual) for one in (point, ended.point))
    return Selection(ended.chosen, ended.places, ended.point, first, before, after)


def _followed(problem: OutputErrorProblem, now: State, cost: float, rows: Rows) -> State:
    """Select candidates as long as one counts, at most `MOST`. cost: cost without any cause."""
    while len(now.chosen) < MOST:
        ways = _next_fits(problem, now, rows)
        if not ways:
            break
        now = _with_fit(problem, now, ways[0], rows)
        now = _exchanged(problem, now, cost, rows) if now.fresh else now
    return now


def _explains_most(rows: Rows, without: Point, there: Point) -> bool:
    """Tell whether the causes at an optimum explain nearly all of the misfit without them."""
    left, whole = (beyond_noise(rows, one.cost) for one in (there, without))
    return left <= (1 - MOST_OF_IT) * whole


def _doubtful(rows: Rows, ended: State) -> bool:
    """Tell whether a selection needs more than SEVERAL candidates, or leaves some of the misfit."""
    return len(ended.chosen) > SEVERAL or misfit_of(rows, ended.point.residual).significant


def _criterion(state: State) -> float:
    """Return cost + k ln n of a state with k sizes."""
    return state.point.cost + np.log(len(state.point.residual)) * len(state.places)


def _next_fits(problem: OutputErrorProblem, now: State, rows: Rows) -> tuple[Way, ...]:
    """Return the fits of the candidates that are left, the best first, if any of them counts."""
    if not now.ranking or now.ranking[0].chance > CHANCE:
        return ()
    if now.ranking[0].score.statistic < _not_followed(now.chosen, now.causes, now.fresh):
        return ()
    return fitted_candidates(problem, now, rows)


def _with_fit(problem: OutputErrorProblem, now: State, one: Way, rows: Rows) -> State:
    """Return the state with a candidate that was fitted."""
    names = tuple(other.candidate.name for other in one.alike)
    gain = now.point.cost - one.fit.point.cost
    added = Selected(one.candidate, one.fit.added, gain, names)
    chosen = _of_places((*now.chosen, added), one.fit.places)
    return _state(problem, now, chosen, one.fit.places, one.fit.point, rows)


def _not_followed(chosen: Sequence[Selected], causes: Sequence[Cause], fresh: bool) -> float:
    """Return the misfit that a fit may leave although its causes are the true ones.

    Columns of another optimum are less exact. At their own optimum, exact causes leave nothing.
    """
    share = 1 - (EXACT if fresh else ALIKE) ** 2
    return share * sum(
        one.gain
        for one in chosen
        if not fresh or not all(causes[place].exact for place in one.places)
    )


def _state(
    problem: OutputErrorProblem,
    before: State,
    chosen: tuple[Selected, ...],
    places: tuple[int, ...],
    point: Point,
    rows: Rows,
    left_out: tuple[int, ...] = (),
) -> State:
    """Return the state at an optimum with the causes at `places`.

    All causes are asked anew if noise does not explain what is left. left_out: indices of causes
    that are not ranked.
    """
    causes = with_fitted(before.causes, places, point.causes)
    fresh = misfit_of(rows, point.residual).significant
    if fresh:
        fitted_model = with_causes(problem, point.causes, point.sizes)
        causes = tuple(
            one if one.anew is None or place in places else one.anew(fitted_model, point.parameters)
            for place, one in enumerate(causes)
        )
        asked = ask(problem, point, causes, places)
    else:
        asked = replace(before.asked, causes=with_fitted(before.asked.causes, places, point.causes))
    there = State(chosen, places, point, causes, asked, (), fresh)
    if not fresh and explained_by_all(point, asked.columns) < _not_followed(chosen, causes, fresh):
        return there
    ranking = tuple(
        one
        for one in rank(asked.causes, asked.columns, point.residual, point.beside_all, rows)
        if not set(one.candidate.places) <= {*places, *left_out}
        and not excluded(causes, one.candidate.places, places)
    )
    return replace(there, ranking=ranking)


def _exchanged(problem: OutputErrorProblem, now: State, cost: float, rows: Rows) -> State:
    """Return a state with another cause in place of one that is there or not, if that is better.

    Such a cause has no size that could become insignificant. It can take up what several causes
    make together, and is asked again once one of these is fitted. cost: cost without any cause.
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
            refitted = fitted(problem, start, now.causes, places, sizes, sizes, free, None)
        except DynamicsError:
            continue
        # if chance explains all others without it, it stays
        if not refitted[0]:
            continue
        others = tuple(other for other in now.chosen if other is not one)
        left = _of_places(others, refitted[0])
        without = _state(problem, now, left, *refitted, rows, one.places)
        ways = _next_fits(problem, without, rows)
        enough = now.point.cost - max(NEAR, INEXACT * now.point.cost)
        if ways and ways[0].fit.point.cost < enough:
            found = _with_fit(problem, without, ways[0], rows)
            *kept, last = found.chosen
            gain = cost - found.point.cost - sum(other.gain for other in kept)
            return replace(found, chosen=(*kept, replace(last, gain=gain)))
    return now


def _simplified(problem: OutputErrorProblem, now: State, rows: Rows) -> State:
    """Return a state with simpler candidates in place of groups, where they explain as much.

    A group of many numbers can be selected because it takes up what causes after it do. So, of
    several that were selected, each group is removed again to first order, and candidates of fewer
    sizes are asked in its place.
    """
    if len(now.chosen) == 1:
        return now
    for one in now.chosen:
        if len(one.places) > 1 and now.causes[one.places[0]].alone:
            now = _in_place_of(problem, now, one, rows)
    return now


def _in_place_of(problem: OutputErrorProblem, now: State, one: Selected, rows: Rows) -> State:
    """Return a state with a simpler candidate in place of `one` if that lowers the criterion."""
    point = now.point
    own = np.isin(now.places, one.places)
    residual = point.residual - point.columns[:, own] @ point.sizes[own]
    beside = point.beside.without(point.columns[:, ~own])
    others = tuple(place for place, out in zip(now.places, own, strict=True) if not out)
    columns = now.asked.columns.copy()
    columns[:, list(now.places)] = point.columns
    found = score(
        beside.part(point.columns[:, own]),
        beside.part(residual),
        np.linalg.norm(point.columns[:, own], axis=0),
    )
    enough = ALIKE**2 * found.statistic
    simpler = [
        other
        for other in rank(now.causes, columns, residual, beside, rows)
        if other.score.freedoms < len(one.places)
        and other.score.statistic >= enough
        and not set(other.candidate.places) & set(others)
        and not excluded(now.causes, other.candidate.places, others)
        and not any(now.causes[place].tried for place in other.candidate.places)
    ]
    for other in simpler[:RIVALS]:
        places = (*others, *other.candidate.places)
        sizes = np.concatenate([point.sizes[~own], other.score.sizes])
        none_held = np.zeros(len(places), dtype=bool)
        try:
            kept, there = fitted(
                problem, point.parameters, now.causes, places, sizes, sizes, none_held, None
            )
        except DynamicsError:
            continue
        inside = tuple(place for place in other.candidate.places if place in kept)
        changed = replace(now, places=kept, point=there)
        if not inside or _criterion(changed) >= _criterion(now):
            continue
        replaced = Selected(other, inside, one.gain + point.cost - there.cost, ())
        chosen = tuple(replaced if each is one else each for each in now.chosen)
        causes = with_fitted(now.causes, kept, there.causes)
        return replace(changed, chosen=_of_places(chosen, kept), causes=causes)
    return now


def _of_places(chosen: tuple[Selected, ...], places: tuple[int, ...]) -> tuple[Selected, ...]:
    """Return selected candidates with only those of their causes that are at `places`.

    A candidate without causes is dropped, and the final candidate takes over its gain.
    """
    inside = [
        replace(one, places=tuple(place for place in one.places if place in places))
        for one in chosen
    ]
    lost = sum(one.gain for one in inside if not one.places)
    *earlier, last = (one for one in inside if one.places)
    return (*earlier, replace(last, gain=last.gain + lost))
