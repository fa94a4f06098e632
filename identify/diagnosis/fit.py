"""Fit of causes beside the parameters, by searches that are repeated until the sizes converge."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array, triangular_factor
from identify.diagnosis.cause import Cause, with_causes
from identify.diagnosis.linearisation import Linearisation, allowed, linearisation, residuals
from identify.diagnosis.score import OrthogonalComplement, Score, score
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.output_error_problem import OutputErrorProblem

# Criteria of one search.
STOP = StopCriteria(cost_tolerance=1e-4, parameter_tolerance=1e-3, max_iterations=5)
ROUNDS = 6  # largest number of searches
FINER = 0.3  # factor of the steps of differences from one search to the next
SLOW = 0.25  # relative fall of the cost in a search, up to which differences become finer
# Number of first searches after which effects that depend on the motion are computed anew.
RENEWALS = 2
STANDS = 2e-4  # relative fall of the cost in a search, up to which sizes have converged
# Mean square change of the residuals, in units of the noise, up to which the columns of the latest
# linearisation stay. A run without derivatives takes a sixth of the time of one that has them.
SETTLED = 2e-2
# Largest assumed ratio of the fall of the cost in a search to that which linearisation predicts.
BEYOND_LINEAR = 4.0
# Criteria of a search for the parameters while trial sizes are held.
FOLLOW = replace(STOP, cost_tolerance=1e-2, max_iterations=6)


class OutOfReachError(Exception):
    """A fit will probably not fall to a cost that would be of use."""


@dataclass(frozen=True)
class Point:
    """Optimum of a problem with some causes, and the linearisation there.

    Attributes
    ----------
    causes : tuple of Cause
        The k causes as they were fitted.
    parameters : ndarray, shape (p,)
        Parameters of the robot.
    sizes : ndarray, shape (k,)
        Sizes of the causes.
    linear : Linearisation
        Residuals, and their columns by parameters and by these causes.
    beside : OrthogonalComplement
        Orthogonal complement of the columns of the parameters that are not at their bounds.
    """

    causes: tuple[Cause, ...]
    parameters: Array
    sizes: Array
    linear: Linearisation
    beside: OrthogonalComplement

    @classmethod
    def of(
        cls,
        problem: OutputErrorProblem,
        causes: tuple[Cause, ...],
        parameters: Array,
        at_bound: NDArray[np.bool_],
        sizes: Array,
        linear: Linearisation,
    ) -> "Point":
        """Return an optimum with its linearisation.

        at_bound (p,): coordinates of the parameters that are held at their bounds.
        """
        bounds = problem.bounds
        slopes = linear.by_parameters @ bounds.slope(bounds.coordinates(parameters))
        beside = OrthogonalComplement.of(slopes[:, ~at_bound])
        return cls(causes, parameters, sizes, linear, beside)

    @property
    def residual(self) -> Array:
        """Residuals (m,)."""
        return self.linear.residual

    @property
    def columns(self) -> Array:
        """Columns (m, k) of the causes."""
        return self.linear.by_causes

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

    @cached_property
    def beside_all(self) -> OrthogonalComplement:
        """Orthogonal complement of the columns of the free parameters and of the causes."""
        return self.beside.without(self.columns)


@dataclass(frozen=True)
class WithCauses:
    """Problem in the coordinates of parameters and causes, see `bounded_least_squares.Problem`.

    The sizes, in units of the causes' steps, follow the coordinates of the parameters. held (k,):
    causes whose sizes do not move. step: step of differences, in the same units. known:
    linearisations by the bytes of their coordinates.
    """

    problem: OutputErrorProblem
    causes: tuple[Cause, ...]
    held: NDArray[np.bool_]
    step: float = 1.0
    known: dict[bytes, Linearisation] = field(default_factory=dict)

    @property
    def steps(self) -> Array:
        """Steps (k,) of the causes, one for a cause that is there or not."""
        return np.array([one.step or 1.0 for one in self.causes])

    def coordinates(self, parameters: Array, sizes: Array) -> Array:
        """Return the coordinates (p + k,) of parameters (p,) and sizes (k,)."""
        return np.concatenate([self.problem.bounds.coordinates(parameters), sizes / self.steps])

    def parameters(self, coordinates: Array) -> Array:
        """Return the parameters (p,) of coordinates (p + k,)."""
        return self.problem.bounds.parameters(coordinates[: len(coordinates) - len(self.causes)])

    def sizes(self, coordinates: Array) -> Array:
        """Return the sizes (k,) of coordinates (p + k,)."""
        return coordinates[len(coordinates) - len(self.causes) :] * self.steps

    def renewed(self, coordinates: Array) -> "WithCauses":
        """Return the problem with effects of causes along the motion at coordinates (p + k,)."""
        parameters = self.parameters(coordinates)
        there = with_causes(self.problem, self.causes, self.sizes(coordinates))
        causes = tuple(
            one if one.renewed is None else one.renewed(there, parameters) for one in self.causes
        )
        return replace(self, causes=causes, known={})

    def cost(self, coordinates: Array) -> float:
        """Return the cost at coordinates (p + k,), infinite where the model cannot run."""
        there = with_causes(self.problem, self.causes, self.sizes(coordinates))
        return there.cost(self.parameters(coordinates))

    def at(self, coordinates: Array) -> Linearisation:
        """Return the linearisation at coordinates (p + k,). Raises LoopFailure."""
        key = coordinates.tobytes()
        if key not in self.known:
            self.known[key] = self._settled(coordinates) or linearisation(
                self.problem,
                self.parameters(coordinates),
                self.causes,
                self.sizes(coordinates),
                range(len(self.causes)),
                self.step,
            )
        return self.known[key]

    def _settled(self, coordinates: Array) -> Linearisation | None:
        """Return the latest linearisation `with_last_columns`, or None if residuals change much."""
        if not self.known:
            return None
        key, latest = next(reversed(self.known.items()))
        before = np.frombuffer(key)
        parameters = self.parameters(coordinates)
        sizes = self.sizes(coordinates)
        change = latest.by_parameters @ (parameters - self.parameters(before))
        change += latest.by_causes @ (sizes - self.sizes(before))
        if not change @ change <= SETTLED * len(change):
            return None
        found = with_last_columns(self.problem, parameters, self.causes, sizes, latest)
        if found is None:
            return None
        change = found.residual - latest.residual
        return found if change @ change <= SETTLED * len(change) else None

    def best_known(self, coordinates: Array, cost: float) -> Array:
        """Return the linearised coordinates of least cost, or these if `cost` is clearly less."""
        costs = {key: float(one.residual @ one.residual) for key, one in self.known.items()}
        key = min(costs, key=lambda one: costs[one], default=b"")
        good_enough = key and costs[key] <= cost * (1 + STOP.cost_tolerance)
        return np.frombuffer(key) if good_enough else coordinates

    def linearise(self, coordinates: Array) -> tuple[float, Array, Array]:
        """Return cost, triangular factor and right-hand side (p + k,) at coordinates (p + k,)."""
        found = self.at(coordinates)
        count = len(coordinates)
        bounds = self.problem.bounds
        rows = triangular_factor(
            found.by_parameters @ bounds.slope(coordinates[: count - len(self.causes)]),
            # the size of a cause stays, too, if its model runs on neither side (NaN)
            np.nan_to_num(found.by_causes) * self.steps * ~self.held,
            found.residual,
        )
        return float(found.residual @ found.residual), rows[:count, :count], rows[:count, count]

    def may_reach(self, coordinates: Array, cost: float) -> bool:
        """Tell whether a search from coordinates (p + k,) may fall to a cost.

        The fall is taken as at most `BEYOND_LINEAR` times what the first linearisation predicts.
        """
        if cost == np.inf:
            return True
        here, _, falls = self.linearise(coordinates)
        return bool(here - BEYOND_LINEAR * (falls @ falls) <= cost)


def with_last_columns(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    sizes: Array,
    last: Linearisation,
) -> Linearisation | None:
    """Return the linearisation `last` with the residuals at parameters (p,) and sizes (k,).

    Returns None if a column is a difference of runs, as kinks of friction change it abruptly.
    last: linearisation nearby. Raises LoopFailure if the model is unstable.
    """
    if any(one.differentiable for one in causes):
        return None
    return replace(last, residual=residuals(with_causes(problem, causes, sizes), parameters))


def fit(
    problem: OutputErrorProblem,
    start: Array,
    causes: Sequence[Cause],
    sizes: Array,
    expected: Array,
    held: NDArray[np.bool_],
    linear: Linearisation | None,
    reach: float = np.inf,
) -> Point:
    """Fit parameters and causes from parameters (p,) and sizes (k,).

    expected (k,): sizes that the search will probably reach. held (k,): causes whose sizes stay
    until a first search has adapted the parameters. linear: linearisation at the start, if it is
    known. reach: cost above which the fit is of no use.

    Raises LoopFailure if the model is unstable at the start, and OutOfReachError if a search will
    probably not fall to `reach`.
    """
    whole = WithCauses(problem, tuple(causes), np.zeros_like(held))
    there = with_causes(problem, causes, sizes)
    coordinates = whole.coordinates(allowed(there, start), sizes)
    if linear is not None:
        whole.known[coordinates.tobytes()] = linear
    count = len(start)
    least = np.array([one.least for one in causes]) / whole.steps
    largest = np.maximum(np.abs(expected), np.abs(sizes))
    far = np.maximum(2 * largest / whole.steps, 10.0)
    spread = there.bounds.spread(coordinates[:count], problem.guess.std)
    limits = np.concatenate([there.bounds.lower, least]), np.concatenate([spread, far])
    if held.any():
        # the parameters adapt before the sizes move, as joints that stick make many minima
        coordinates = minimise(replace(whole, held=held), coordinates, *limits, FOLLOW).parameters
    renewing = RENEWALS if any(one.renewed for one in causes) else 0
    for _ in range(ROUNDS):
        if not whole.may_reach(coordinates, reach):
            raise OutOfReachError
        # each search widens the trust region again, which kinks of friction have narrowed
        found = minimise(whole, coordinates, *limits, STOP)
        coordinates = found.parameters
        fall = (found.costs[0] - found.costs[-1]) / found.costs[-1]
        exact = not any(one.differentiable for one in whole.causes)
        if not renewing and (fall <= STANDS or (exact and found.iterations < STOP.max_iterations)):
            break
        if renewing:
            whole = whole.renewed(coordinates)
            renewing -= 1
        if fall <= SLOW:
            # Joints that stick make kinks. Far from the optimum, coarse differences pass over them.
            whole = replace(whole, step=FINER * whole.step, known={})
    coordinates = whole.best_known(found.parameters, found.costs[-1])
    return Point.of(
        problem,
        whole.causes,
        whole.parameters(coordinates),
        found.at_bound[:count],
        whole.sizes(coordinates),
        whole.at(coordinates),
    )
