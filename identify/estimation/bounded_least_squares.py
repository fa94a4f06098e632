"""Bounded Gauss-Newton with a trust region for nonlinear least squares (eq. 32-35).

It minimises |r(p)|^2 with the Jacobian J of r. The paper's update (eq. 33, with the residual in
place of its square) solves the linear problem without limits. Here the step stays inside the
parameters' bounds and inside a box that shrinks when the model of the cost was wrong, which keeps
it from stalling near unstable loops.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dynamics import DynamicsError
from identify.arrays import Array

# factors of the trust region's radius
SHRINK = 0.25
GROW = 2.0

# ratios of the gain to the predicted one, below or above which the radius changes
POOR = 0.25
GOOD = 0.75

SMALLEST_RADIUS = 1e-10
AT_BOUND = 1e-12  # share of the parameter's scale that rounding may leave

Linearisation = tuple[float, Array, Array]


class Problem(Protocol):
    """Problem that the solver minimises."""

    def cost(self, parameters: Array) -> float:
        """Return |r|^2, which is infinite where the model cannot run."""
        ...

    def linearise(self, parameters: Array) -> Linearisation:
        """Return |r|^2, and a factor R (p, p) with a vector d (p,) of the linearised problem.

        For these, |r + J step|^2 = |d + R step|^2 + constant. Raises DynamicsError where the model
        cannot run.
        """
        ...


@dataclass(frozen=True)
class StopCriteria:
    """Criteria of eq. 35 by which a search stops.

    The tolerances, tol1 and tol2, are relative changes of the cost and of every parameter.
    """

    cost_tolerance: float
    parameter_tolerance: float
    max_iterations: int


@dataclass(frozen=True)
class Solution:
    """Parameters (p,) that a search found, and the reason why it stopped.

    at_bound (p,): which parameters are at their bounds. costs: at the start and after each
    iteration. evaluations: number of those of the model.
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
) -> Solution:
    """Minimise a least-squares problem within lower bounds.

    Parameters
    ----------
    problem : Problem
        Problem to minimise.
    start, lower : ndarray, shape (p,)
        Parameters at the start, and their lower bounds.
    scale : ndarray, shape (p,)
        Size of a large change of each parameter.
    criteria : StopCriteria
        Criteria by which the search stops.
    on_iteration : callable
        Function (number of the iteration, cost) that is called after each.
    ahead : bool
        True allows linearising the problem at a trial that is then not taken. A problem that
        follows its own steps does not allow it.
    """
    parameters = start.copy()
    radius = 1.0
    trusted = True
    cost, factor, residual = problem.linearise(parameters)
    costs = [cost]
    evaluations = 1
    reason = ""
    while not reason:
        step, predicted = _box_step(factor, residual, parameters, lower, scale, radius)
        trial = np.maximum(parameters + step, lower)
        evaluations += predicted > 0
        goes_on = ahead and trusted and predicted > criteria.cost_tolerance * cost
        new_cost, linearised = _tried(problem, trial, goes_on) if predicted > 0 else (cost, None)
        ratio = (cost - new_cost) / predicted if predicted > 0 else 0.0
        trusted = ratio > POOR
        largest = float(np.abs(step / scale).max())
        tried = radius
        radius = _new_radius(radius, ratio, largest)
        if ratio > 0:
            # A step cut short by the trust region says nothing about convergence.
            if largest < 0.9 * tried:
                change = _relative_change(step, parameters, scale)
                reason = _converged(cost, new_cost, change, criteria)
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
    """Return the cost of a trial (p,) and, if the search may go on there, its linearisation.

    The linearisation gives the cost as well, which would be computed twice otherwise.
    """
    if not goes_on:
        return problem.cost(trial), None
    try:
        linearised = problem.linearise(trial)
    except DynamicsError:
        return np.inf, None
    return linearised[0], linearised


def _box_step(
    factor: Array, residual: Array, parameters: Array, lower: Array, scale: Array, radius: float
) -> tuple[Array, float]:
    """Return the minimiser of the linearised cost in the box, and the gain that it predicts."""
    low = np.maximum((lower - parameters) / scale, -radius)
    scaled = factor * scale
    box = (np.minimum(low, -1e-15), np.full(len(scale), radius))
    solved = lsq_linear(scaled, -residual, bounds=box, method="bvls")
    gain = residual @ residual - np.sum((residual + scaled @ solved.x) ** 2)
    return solved.x * scale, float(gain)


def _new_radius(radius: float, ratio: float, largest: float) -> float:
    if ratio < POOR:
        return SHRINK * largest
    if ratio > GOOD and largest > 0.9 * radius:
        return GROW * radius
    return radius


def _relative_change(step: Array, parameters: Array, scale: Array) -> float:
    """Return max |step_i / p_i| of eq. 35. A parameter near zero counts by its scale."""
    return float(np.max(np.abs(step) / np.maximum(np.abs(parameters), 1e-3 * scale)))


def _converged(cost: float, new_cost: float, change: float, criteria: StopCriteria) -> str:
    gain = (cost - new_cost) / cost
    if gain <= criteria.cost_tolerance:
        return f"cost changed by {gain:.2e} <= tol1 = {criteria.cost_tolerance:g} (eq. 35)"
    if change <= criteria.parameter_tolerance:
        return (
            f"parameters changed by {change:.2e} <= tol2 = {criteria.parameter_tolerance:g} (eq. "
            "35)"
        )
    return ""
