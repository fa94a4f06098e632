"""Bounded Gauss-Newton with a trust region for nonlinear least squares (eq. 32-35).

It minimises |r(p)|^2 with the Jacobian J of r. The paper's update (eq. 33, with the residual in
place of its square) solves the linear problem without limits. Here the step is limited by the
bounds of the parameters, and by a box that shrinks if the cost falls much less than predicted. The
box prevents stalling near unstable loops.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dynamics import DynamicsError
from identify.arrays import Array


@dataclass(frozen=True)
class StopCriteria:
    """Criteria of eq. 35 by which a search stops.

    cost_tolerance, parameter_tolerance: tol1 and tol2, the relative changes of the cost and of the
    parameters at or below which a search has converged. max_iterations: most steps of a search.
    """

    cost_tolerance: float
    parameter_tolerance: float
    max_iterations: int


def relative_change(step: Array, parameters: Array, scale: Array) -> float:
    """Return max |step_i / p_i| of eq. 35, where |p_i| counts as at least 1e-3 of its scale."""
    return float(np.max(np.abs(step) / np.maximum(np.abs(parameters), 1e-3 * scale)))


def converged(cost: float, new_cost: float, change: float, criteria: StopCriteria) -> str:
    """Return the reason why a search has converged, or an empty text if it has not.

    cost, new_cost: costs before and after a step. change: `relative_change` by the step.
    """
    gain = (cost - new_cost) / cost
    if gain <= criteria.cost_tolerance:
        return (
            f"the relative change of the cost {gain:.2e} <= tol1 = {criteria.cost_tolerance:g} "
            "(identification.cost_tolerance, eq. 35 of the paper)"
        )
    if change <= criteria.parameter_tolerance:
        return (
            f"the relative change of the parameters {change:.2e} <= tol2 = "
            f"{criteria.parameter_tolerance:g} (identification.parameter_tolerance, eq. 35 of the "
            "paper)"
        )
    return ""


# After a poor step, the radius of the trust region is SHRINK times the length of this step. After a
# good step that reached the radius, the radius is multiplied by GROW.
SHRINK = 0.25
GROW = 2.0

# Ratios of the gain to the predicted gain. Below POOR a step is poor, above GOOD it is good.
POOR = 0.25
GOOD = 0.75

SMALLEST_RADIUS = 1e-10  # radius below which a failed step ends the search
AT_BOUND = 1e-12  # distance from a bound that counts as rounding, in scales of the parameter

Linearisation = tuple[float, Array, Array]

# Function (factor, residual, parameters, lower bounds, scale, radius) -> (step, predicted gain). A
# gain is a decrease of the cost. The step stays within the bounds and `radius` times the scale.
Proposal = Callable[[Array, Array, Array, Array, Array, float], tuple[Array, float]]


class Problem(Protocol):
    """Problem that the solver minimises."""

    def cost(self, parameters: Array) -> float:
        """Return |r|^2. It is infinite if the model is unstable."""
        ...

    def linearise(self, parameters: Array) -> Linearisation:
        """Return |r|^2, and a factor R (p, p) with a vector d (p,) of the linearised problem.

        They satisfy |r + J step|^2 = |d + R step|^2 + constant. Raises DynamicsError if the model
        is unstable.
        """
        ...


@dataclass(frozen=True)
class Solution:
    """Parameters (p,) found by a search, and the reason why it stopped.

    at_bound (p,): True for parameters at their lower bounds. costs: cost at the start and after
    each iteration, which is a step that lowered the cost. evaluations: number of evaluations of the
    model, failed steps included.
    """

    parameters: Array
    at_bound: NDArray[np.bool_]
    costs: tuple[float, ...]
    evaluations: int
    stop_reason: str

    @property
    def iterations(self) -> int:
        """Number of steps taken."""
        return len(self.costs) - 1


def minimise(
    problem: Problem,
    start: Array,
    lower: Array,
    scale: Array,
    criteria: StopCriteria,
    on_iteration: Callable[[int, float], None] = lambda iteration, cost: None,
    ahead: bool = True,
    upper: Array | None = None,
    propose: Proposal | None = None,
) -> Solution:
    """Minimise a least-squares problem within bounds.

    The search ends when it has converged, when no step lowers the cost, or by `max_iterations`.

    problem            Problem to minimise.
    start, lower (p,)  Parameters at the start, and their lower bounds.
    scale (p,)         Large change of each parameter, and unit of the trust region's radius.
    criteria           Criteria by which the search stops.
    on_iteration       Function (number of the iteration, cost) that is called after each iteration.
    ahead              True if the problem can be linearised at a trial step before the step is
                       accepted. This must be False for a problem with a state that follows the
                       accepted steps.
    upper (p,)         Upper bounds. None means no upper bounds.
    propose            Function that chooses a step. The default minimises the linearised cost.

    Raises DynamicsError if the model is unstable at the start.
    """
    if upper is None:
        upper = np.full(len(start), np.inf)
    propose = propose or partial(_box_step, upper)
    parameters = start.copy()
    radius = 1.0
    trusted = True
    cost, factor, residual = problem.linearise(parameters)
    costs = [cost]
    evaluations = 1
    reason = ""
    while not reason:
        step, predicted = propose(factor, residual, parameters, lower, scale, radius)
        trial = np.clip(parameters + step, lower, upper)
        evaluations += predicted > 0
        goes_on = ahead and trusted and predicted > criteria.cost_tolerance * cost
        new_cost, linearised = _tried(problem, trial, goes_on) if predicted > 0 else (cost, None)
        ratio = (cost - new_cost) / predicted if predicted > 0 else 0.0
        trusted = ratio > POOR
        largest = float(np.abs(step / scale).max())
        old_radius = radius
        radius = _new_radius(radius, ratio, largest)
        if ratio > 0:
            # A step limited by the trust region is no evidence of convergence.
            if largest < 0.9 * old_radius:
                change = relative_change(step, parameters, scale)
                reason = converged(cost, new_cost, change, criteria)
            if not reason and len(costs) >= criteria.max_iterations:
                reason = f"stopped after max_iterations = {criteria.max_iterations}"
            parameters = trial
            cost = new_cost
            costs.append(cost)
            on_iteration(len(costs) - 1, cost)
            if not reason:
                evaluations += linearised is None
                cost, factor, residual = linearised or problem.linearise(parameters)
        elif radius < SMALLEST_RADIUS or predicted <= criteria.cost_tolerance * cost:
            reason = f"no step lowers the cost: predicted gain {predicted:.3g} of {cost:.6g}"
    at_bound = parameters <= lower + AT_BOUND * scale
    return Solution(parameters, at_bound, tuple(costs), evaluations, reason)


def _tried(problem: Problem, trial: Array, goes_on: bool) -> tuple[float, Linearisation | None]:
    """Return the cost of a trial (p,) and, with `goes_on`, its linearisation.

    The linearisation includes the cost, so a separate computation of the cost is avoided.
    """
    if not goes_on:
        return problem.cost(trial), None
    try:
        linearised = problem.linearise(trial)
    except DynamicsError:
        return np.inf, None
    return linearised[0], linearised


def _box_step(
    upper: Array,
    factor: Array,
    residual: Array,
    parameters: Array,
    lower: Array,
    scale: Array,
    radius: float,
) -> tuple[Array, float]:
    """Return the step to the minimum of the linearised cost in the box, and the predicted gain."""
    low = np.maximum((lower - parameters) / scale, -radius)
    high = np.minimum((upper - parameters) / scale, radius)
    scaled = factor * scale
    # The box always contains the step zero.
    box = (np.minimum(low, -1e-15), np.maximum(high, 1e-15))
    solved = lsq_linear(scaled, -residual, bounds=box, method="bvls")
    gain = residual @ residual - np.sum((residual + scaled @ solved.x) ** 2)
    return solved.x * scale, float(gain)


def _new_radius(radius: float, ratio: float, largest: float) -> float:
    if ratio < POOR:
        return SHRINK * largest
    if ratio > GOOD and largest > 0.9 * radius:
        return GROW * radius
    return radius
