"""Convergence of a search for parameters (eq. 35)."""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array


@dataclass(frozen=True)
class StopCriteria:
    """Criteria of eq. 35 by which a search stops.

    The tolerances tol1 and tol2 are relative changes of the cost and of the parameters.
    """

    cost_tolerance: float
    parameter_tolerance: float
    max_iterations: int


def relative_change(step: Array, parameters: Array, scale: Array) -> float:
    """Return max |step_i / p_i| of eq. 35. For a parameter near zero, its scale replaces p_i."""
    return float(np.max(np.abs(step) / np.maximum(np.abs(parameters), 1e-3 * scale)))


def converged(cost: float, new_cost: float, change: float, criteria: StopCriteria) -> str:
    """Return the reason why a search has converged, or an empty text.

    cost, new_cost: costs before and after a step. change: `relative_change` by the step.
    """
    gain = (cost - new_cost) / cost
    if gain <= criteria.cost_tolerance:
        return f"cost changed by {gain:.2e} <= tol1 = {criteria.cost_tolerance:g} (eq. 35)"
    if change <= criteria.parameter_tolerance:
        return (
            f"parameters changed by {change:.2e} <= tol2 = {criteria.parameter_tolerance:g} (eq. "
            "35)"
        )
    return ""
