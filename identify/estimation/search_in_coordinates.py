"""Searches in the coordinates of `bounds` in place of the parameters.

The parameters are a function of the coordinates. If this function is linear, the problem is
linearised in the coordinates. The function of log-Cholesky coordinates is curved. The problem is
then linearised in the parameters only, and a step follows the curved function to the least
linearised cost. Such a step needs no run of the model. If the curved function were linearised too,
steps would be short where the data determine the parameters well.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from identify.arrays import Array
from identify.estimation.bounded_least_squares import (
    Linearisation,
    Problem,
    Solution,
    StopCriteria,
    minimise,
)
from identify.estimation.bounds import ParameterBounds

# Criteria of the search for a step along a curved function.
ALONG_CURVE = StopCriteria(cost_tolerance=1e-10, parameter_tolerance=0.0, max_iterations=200)


@dataclass(frozen=True)
class InCoordinates:
    """Least-squares problem in coordinates of bounds, see `bounded_least_squares.Problem`."""

    problem: Problem
    bounds: ParameterBounds

    def cost(self, coordinates: Array) -> float:
        """Return the cost at coordinates (p,)."""
        return self.problem.cost(self.parameters(coordinates))

    def linearise(self, coordinates: Array) -> Linearisation:
        """Return cost and linearisation at coordinates (p,)."""
        cost, factor, residual = self.problem.linearise(self.parameters(coordinates))
        return cost, factor @ self.bounds.slope(coordinates), residual

    def parameters(self, coordinates: Array) -> Array:
        """Return the parameters (p,) of coordinates (p,). They can be infinite or NaN far away."""
        # The exponentials of log-Cholesky coordinates can make a body larger than any number.
        with np.errstate(over="ignore", invalid="ignore"):
            return self.bounds.parameters(coordinates)


@dataclass(frozen=True)
class _LinearInParameters(InCoordinates):
    """Problem whose unknowns are coordinates, but which is linearised in the parameters."""

    def linearise(self, coordinates: Array) -> Linearisation:
        """Return the cost at coordinates (p,), and the linearisation at their parameters."""
        return self.problem.linearise(self.parameters(coordinates))


@dataclass(frozen=True)
class _Linearised:
    """Problem to minimise |residual + factor @ (parameters - at)|^2 over the parameters."""

    at: Array
    factor: Array
    residual: Array

    def cost(self, parameters: Array) -> float:
        return self.linearise(parameters)[0]

    def linearise(self, parameters: Array) -> Linearisation:
        if not np.isfinite(parameters).all():
            return np.inf, self.factor, self.residual
        residual = self.residual + self.factor @ (parameters - self.at)
        return float(residual @ residual), self.factor, residual


def minimise_in_coordinates(
    problem: Problem,
    bounds: ParameterBounds,
    start: Array,
    scale: Array,
    criteria: StopCriteria,
    on_iteration: Callable[[int, float], None] = lambda iteration, cost: None,
    ahead: bool = True,
) -> Solution:
    """Minimise a least-squares problem in coordinates of bounds.

    start, scale (p,): coordinates at the start, and their typical changes. The parameters of the
    solution are coordinates, too. For the other arguments see `bounded_least_squares.minimise`.
    """
    arguments = start, bounds.lower, scale, criteria, on_iteration, ahead
    if not bounds.log_cholesky:
        return minimise(InCoordinates(problem, bounds), *arguments)
    along = partial(_step_along_curve, bounds)
    return minimise(_LinearInParameters(problem, bounds), *arguments, propose=along)


def _step_along_curve(
    bounds: ParameterBounds,
    factor: Array,
    residual: Array,
    coordinates: Array,
    lower: Array,
    scale: Array,
    radius: float,
) -> tuple[Array, float]:
    """Return the step of coordinates (p,) to the least linearised cost in the box.

    The second result is the predicted gain. factor, residual: linearisation in the parameters.
    """
    linearised = _Linearised(bounds.parameters(coordinates), factor, residual)
    found = minimise(
        InCoordinates(linearised, bounds),
        coordinates,
        np.maximum(lower, coordinates - radius * scale),
        scale,
        ALONG_CURVE,
        upper=coordinates + radius * scale,
    )
    return found.parameters - coordinates, found.costs[0] - found.costs[-1]
