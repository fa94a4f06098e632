"""Asking of causes: at an optimum, the columns that show what each of them would explain."""

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

    Of its trial sizes, a cause keeps only the one that explains most. Its column is the change of
    the residuals at that size, divided by the size. All are kept if none explains anything.
    """

    causes: tuple[Cause, ...]
    columns: Array


def ask(
    problem: OutputErrorProblem, point: Point, causes: Sequence[Cause], places: tuple[int, ...]
) -> Asked:
    """Return the causes as asked at an optimum. places: indices of those that are fitted there."""
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
    """Return the optimum at `parameters` (p,) without any cause, and the causes as asked there.

    at_bound (p,): coordinates of the parameters that are held at their bounds. Both results share
    one linearisation.
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
    """Return the indices of the causes that can be asked beside the fitted ones at `places`.

    Companions are left out, as they have no effect before their causes are fitted.
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
    """Try the trial sizes of causes, and return the causes with their columns, see `Asked`.

    sizes (k,): sizes at the optimum. asked: indices of the causes that are asked. columns (m, k):
    changed in place.
    """
    chosen = list(causes)
    rest = point.beside_all.part(point.residual)
    fitted = with_causes(problem, causes, sizes)
    trials = [(place, size) for place in asked for size in causes[place].tried]
    problems = [causes[place].change(fitted, size) for place, size in trials]
    gains = np.zeros(len(causes))
    for (place, size), moved in zip(
        trials, each_residuals(problems, point.parameters), strict=True
    ):
        if moved is None:
            continue
        column = ((moved - point.residual) / size)[:, None]
        found = score(point.beside_all.part(column), rest, np.linalg.norm(column, axis=0))
        if found.sizes[0] > 0 and found.statistic > gains[place]:
            gains[place] = found.statistic
            columns[:, place] = column[:, 0]
            chosen[place] = replace(causes[place], tried=(size,))
    return Asked(tuple(chosen), columns)
