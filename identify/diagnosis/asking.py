"""Causes as they are asked at an optimum: their columns, and sizes at which some are tried."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.diagnosis.cause import Cause, with_causes
from identify.diagnosis.fit import Point
from identify.diagnosis.linearisation import each_residuals, linearisation
from identify.diagnosis.score import score
from identify.estimation.output_error_problem import OutputErrorProblem


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
