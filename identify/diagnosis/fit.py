"""Fit of causes beside the parameters, with the model linearised anew until their sizes stand."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array, triangular_factor
from identify.diagnosis.cause import Cause, with_causes
from identify.diagnosis.score import (
    OrthogonalComplement,
    Score,
    allowed,
    cause_columns,
    parameter_columns,
    score,
)
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.output_error import OutputErrorProblem

STOP = StopCriteria(cost_tolerance=1e-4, parameter_tolerance=1e-3, max_iterations=6)
"""Criteria of one search. The causes' columns stay as they are during it."""

REFRESHES = 3
"""Largest number of searches, each with the columns of the causes at the sizes before."""

STANDS = 0.3
"""Largest change of a size by another search, in standard deviations, at which it stands."""


@dataclass(frozen=True)
class Point:
    """Optimum of a problem with some causes, and its linearisation there.

    Attributes
    ----------
    parameters : ndarray, shape (p,)
        Parameters of the robot.
    sizes : ndarray, shape (k,)
        Sizes of the causes.
    residual : ndarray, shape (m,)
        Residuals.
    beside : OrthogonalComplement
        Space beside the columns of the parameters that no bound holds.
    columns : ndarray, shape (m, k)
        Columns of the causes.
    """

    parameters: Array
    sizes: Array
    residual: Array
    beside: OrthogonalComplement
    columns: Array

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(self.residual @ self.residual)

    def score(self) -> Score:
        """Return the score of the causes: what another step would change."""
        return score(
            self.beside.part(self.columns),
            self.beside.part(self.residual),
            np.linalg.norm(self.columns, axis=0),
        )

    @property
    def beside_all(self) -> OrthogonalComplement:
        """Space beside the columns of the parameters and of the causes."""
        return self.beside.without(self.columns)


@dataclass(frozen=True)
class WithCauses:
    """Problem in the coordinates of parameters and causes, see `bounded_least_squares.Problem`.

    The sizes stand behind the coordinates of the parameters, in steps of the causes. columns (m,
    k): derivatives of the residuals with respect to the sizes.
    """

    problem: OutputErrorProblem
    causes: tuple[Cause, ...]
    columns: Array

    @property
    def steps(self) -> Array:
        """Steps (k,) of the causes, one for a cause that is there or not."""
        return steps_of(self.causes)

    def parameters(self, coordinates: Array) -> Array:
        """Return the parameters (p,) of coordinates (p + k,)."""
        return self.problem.bounds.parameters(coordinates[: len(coordinates) - len(self.causes)])

    def sizes(self, coordinates: Array) -> Array:
        """Return the sizes (k,) of coordinates (p + k,)."""
        return coordinates[len(coordinates) - len(self.causes) :] * self.steps

    def at(self, coordinates: Array) -> OutputErrorProblem:
        """Return the problem with the causes at coordinates (p + k,)."""
        return with_causes(self.problem, self.causes, self.sizes(coordinates))

    def cost(self, coordinates: Array) -> float:
        """Return the cost at coordinates (p + k,), infinite where the model cannot run."""
        return self.at(coordinates).cost(self.parameters(coordinates))

    def linearise(self, coordinates: Array) -> tuple[float, Array, Array]:
        """Return cost and linearisation at coordinates (p + k,)."""
        residual, slopes = parameter_columns(self.at(coordinates), self.parameters(coordinates))
        rows = triangular_factor(
            slopes @ self.problem.bounds.slope(coordinates[: slopes.shape[1]]),
            self.columns * self.steps,
            residual,
        )
        count = len(coordinates)
        return float(residual @ residual), rows[:count, :count], rows[:count, count]


def steps_of(causes: Sequence[Cause]) -> Array:
    """Return the steps (k,) of causes, one for a cause that is there or not."""
    return np.array([one.step or 1.0 for one in causes])


def linearised(
    problem: OutputErrorProblem,
    parameters: Array,
    at_bound: NDArray[np.bool_],
    causes: Sequence[Cause],
    sizes: Array,
) -> Point:
    """Return the linearisation of a problem with causes at parameters (p,) and sizes (k,).

    at_bound (p,): coordinates of the parameters that are held at their bounds. Raises LoopFailure
    if the model is unstable.
    """
    there = with_causes(problem, causes, sizes)
    residual, slopes = parameter_columns(there, parameters)
    bounds = problem.bounds
    free = (slopes @ bounds.slope(bounds.coordinates(parameters)))[:, ~at_bound]
    # a cause is changed from its size while all others stay
    columns = cause_columns(problem, parameters, causes, sizes)
    return Point(parameters, sizes, residual, OrthogonalComplement.of(free), columns)


def fit(
    problem: OutputErrorProblem,
    start: Array,
    causes: tuple[Cause, ...],
    sizes: Array,
    columns: Array,
) -> Point:
    """Fit parameters and causes from parameters (p,), sizes (k,) and columns (m, k) at them.

    Raises LoopFailure if the model is unstable at the start.
    """
    there = with_causes(problem, causes, sizes)
    bounds = there.bounds
    steps = steps_of(causes)
    least = np.array([one.least for one in causes])
    parameters = allowed(there, start)
    # A cause that is tried at a size stays there until the parameters have followed. The chord to
    # it, by which it was ranked, leads the search astray.
    columns = columns * [float(not one.tried) for one in causes]
    for _ in range(REFRESHES):
        whole = WithCauses(problem, causes, columns)
        coordinates = np.concatenate([bounds.coordinates(parameters), sizes / steps])
        spread = bounds.spread(coordinates[: len(parameters)], problem.guess.std)
        far = np.maximum(2 * np.abs(sizes / steps), 10.0)
        found = minimise(
            whole,
            coordinates,
            np.concatenate([bounds.lower, least / steps]),
            np.concatenate([spread, far]),
            STOP,
        )
        parameters = whole.parameters(found.parameters)
        sizes = whole.sizes(found.parameters)
        held = found.at_bound[: len(parameters)]
        point = linearised(problem, parameters, held, causes, sizes)
        columns = point.columns
        left = point.score()
        if (np.abs(left.sizes) <= STANDS * np.sqrt(np.diag(left.covariance()))).all():
            break
    return point
