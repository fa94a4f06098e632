"""The search is checked against scipy's own solver and against problems whose minimum is known."""

import numpy as np
import pytest
from scipy.optimize import least_squares, nnls

from identify.estimation.bounded_least_squares import StopCriteria, minimise

CRITERIA = StopCriteria(cost_tolerance=1e-12, parameter_tolerance=1e-9, max_iterations=200)


class FromFunctions:
    def __init__(self, residual, jacobian):
        self.residual, self.jacobian = residual, jacobian

    def cost(self, parameters):
        return float(np.sum(self.residual(parameters) ** 2))

    def linearise(self, parameters):
        residual, jacobian = self.residual(parameters), self.jacobian(parameters)
        factor = np.linalg.qr(np.column_stack([jacobian, residual]), mode="r")
        n = len(parameters)
        return float(residual @ residual), factor[:n, :n], factor[:n, n]


def exponential():
    t = np.linspace(0, 3, 40)
    data = 2.0 * np.exp(-1.3 * t) + 0.05 * np.sin(20 * t)
    return FromFunctions(
        lambda p: p[0] * np.exp(-p[1] * t) - data,
        lambda p: np.column_stack([np.exp(-p[1] * t), -p[0] * t * np.exp(-p[1] * t)]),
    )


def test_it_finds_the_minimum_that_scipy_finds():
    problem = exponential()
    mine = minimise(problem, np.array([0.5, 4.0]), np.zeros(2), np.ones(2), CRITERIA)
    scipys = least_squares(problem.residual, [0.5, 4.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.allclose(mine.parameters, scipys.x, rtol=1e-6)
    assert np.all(np.diff(mine.costs) < 0)


def test_it_stays_inside_the_bounds_and_finds_the_constrained_minimum():
    problem = exponential()
    lower = np.array([0.0, 2.0])
    mine = minimise(problem, np.array([0.5, 4.0]), lower, np.ones(2), CRITERIA)
    scipys = least_squares(problem.residual, [0.5, 4.0], bounds=(lower, np.inf), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert mine.parameters[1] >= 2.0
    assert np.allclose(mine.parameters, scipys.x, rtol=1e-5)


def test_a_start_on_a_bound_does_not_hold_the_search_up():
    """The model cannot run below its bounds, and a step along a bound may end below it by rounding."""
    problem = exponential()
    plain = problem.cost
    problem.cost = lambda p: plain(p) if np.all(p >= 0.0) else np.inf
    free = minimise(problem, np.array([0.0, 0.0]), np.zeros(2), np.array([0.3, 0.7]), CRITERIA)
    assert np.allclose(free.parameters, least_squares(problem.residual, [1.0, 1.0], xtol=1e-15).x, rtol=1e-5)


def test_parameters_held_at_their_bound_stay_there_exactly():
    """The unconstrained minimum has a negative entry: it ends at zero, and the others still move."""
    matrix = np.random.default_rng(2).standard_normal((30, 5))
    target = matrix @ np.array([1.0, -2.0, 0.5, 3.0, -0.1])
    problem = FromFunctions(lambda p: matrix @ p - target, lambda p: matrix)
    plain = problem.cost
    problem.cost = lambda p: plain(p) if np.all(p >= 0.0) else np.inf
    found = minimise(problem, np.array([1.0, 0.0, 1.0, 1.0, 0.0]), np.zeros(5), np.full(5, 0.37), CRITERIA)
    expected = nnls(matrix, target)[0]
    assert np.allclose(found.parameters, expected, atol=1e-9)
    assert np.all(found.parameters >= 0)


def test_a_region_where_the_model_cannot_run_is_stepped_around():
    """Rosenbrock's valley with infinite cost on one side: the trust region shrinks and goes on."""
    problem = FromFunctions(
        lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]), lambda p: np.array([[-20 * p[0], 10], [-1, 0]])
    )
    plain = problem.cost
    problem.cost = lambda p: np.inf if p[1] > 1.6 else plain(p)
    found = minimise(problem, np.array([-1.2, 1.0]), np.full(2, -np.inf), np.ones(2), CRITERIA)
    assert np.allclose(found.parameters, [1, 1], atol=1e-5)


def test_the_stop_reason_names_the_criterion():
    one = minimise(exponential(), np.array([0.5, 4.0]), np.zeros(2), np.ones(2), StopCriteria(1e-3, 1e-12, 50))
    assert "tol1 = 0.001" in one.stop_reason
    assert "eq. 35" in one.stop_reason
    two = minimise(exponential(), np.array([0.5, 4.0]), np.zeros(2), np.ones(2), StopCriteria(1e-15, 1e-15, 2))
    assert "max_iterations = 2" in two.stop_reason
    assert two.iterations == 2


class Counted:
    """A problem that remembers what it was asked for."""

    def __init__(self, problem):
        self.problem, self.calls = problem, []

    def cost(self, parameters):
        self.calls.append("cost")
        return self.problem.cost(parameters)

    def linearise(self, parameters):
        self.calls.append("linearise")
        return self.problem.linearise(parameters)


@pytest.mark.parametrize("criteria", [(1e-3, 1e-12, 50), (1e-15, 1e-15, 2), (0.0, 0.0, 200)])
def test_every_linearisation_is_stepped_from(criteria):
    """However the search ends: converged, after the iterations allowed, or without a step that lowers the cost."""
    problem = Counted(exponential())
    found = minimise(problem, np.array([0.5, 4.0]), np.zeros(2), np.ones(2), StopCriteria(*criteria))
    stuck = found.stop_reason.startswith("no step")
    assert stuck == (criteria[0] == 0)
    assert problem.calls.count("linearise") == found.iterations + stuck
    assert found.evaluations == len(problem.calls)
    assert found.costs[-1] == exponential().cost(found.parameters)
