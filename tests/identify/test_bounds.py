"""Bounded least squares: the search against scipy's solvers, among bodies that can exist, and the
intervals that hold.

The linear problems have known statistics: the estimate without bounds is that of
`numpy.linalg.lstsq`.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares, minimize, nnls

from dynamics.inertia import UnphysicalInertiaError, physical_inertias
from dynamics.pseudo_inertia import pseudo_inertia
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.bounds import ParameterBounds, parameter_bounds
from identify.estimation.identification import identify
from identify.estimation.intervals import BoundedEstimate, bounded_estimate
from identify.estimation.prior import StartingGuess
from identify.estimation.search_in_coordinates import minimise_in_coordinates
from identify.scenario import load_scenario
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    guess_of,
    index_of,
    quick,
    rss6,
    run_plant,
    truth,
)

CRITERIA = StopCriteria(cost_tolerance=1e-12, parameter_tolerance=1e-9, max_iterations=200)
DRAWS = 500
# What chance makes of 95 % in so many draws, in one of a thousand tests.
LOWEST = 0.95 - 3 * np.sqrt(0.95 * 0.05 / DRAWS)


class FromFunctions:
    """A problem; allowed(parameters) says where its model can run."""

    def __init__(self, residual, jacobian, allowed=lambda p: True):
        self.residual, self.jacobian, self.allowed = residual, jacobian, allowed

    def cost(self, parameters):
        return float(np.sum(self.residual(parameters) ** 2)) if self.allowed(parameters) else np.inf

    def linearise(self, parameters):
        residual, jacobian = self.residual(parameters), self.jacobian(parameters)
        factor = np.linalg.qr(np.column_stack([jacobian, residual]), mode="r")
        n = len(parameters)
        return float(residual @ residual), factor[:n, :n], factor[:n, n]


def not_below_zero(parameters):
    return np.all(parameters >= 0.0)


def exponential(**where):
    t = np.linspace(0, 3, 40)
    data = 2.0 * np.exp(-1.3 * t) + 0.05 * np.sin(20 * t)
    return FromFunctions(
        lambda p: p[0] * np.exp(-p[1] * t) - data,
        lambda p: np.column_stack([np.exp(-p[1] * t), -p[0] * t * np.exp(-p[1] * t)]),
        **where,
    )


def linear(matrix, data, **where):
    return FromFunctions(lambda p: matrix @ p - data, lambda p: matrix, **where)


@pytest.mark.parametrize(
    ("start", "lower"),
    [((0.5, 4.0), (0.0, 0.0)), ((0.5, 4.0), (0.0, 2.0)), ((0.0, 0.0), (0.0, 0.0))],
    ids=["free", "bound", "from a bound"],
)
def test_it_finds_the_minimum_that_scipy_finds_within_the_bounds(start, lower):
    """The model cannot run below its bounds, and a step along a bound may end below it by
    rounding."""
    problem = exponential(allowed=not_below_zero)
    mine = minimise(problem, np.array(start), np.array(lower), np.array([0.3, 0.7]), CRITERIA)
    scipys = least_squares(
        problem.residual, [0.5, 4.0], bounds=(lower, np.inf), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert mine.parameters[1] >= lower[1]
    assert np.allclose(mine.parameters, scipys.x, rtol=1e-5 if lower[1] else 1e-6)
    assert np.all(np.diff(mine.costs) < 0) or lower[1] > 0.0


def test_parameters_held_at_their_bound_stay_there_exactly():
    """The unconstrained minimum has a negative entry: it ends at zero, and the others still
    move."""
    matrix = np.random.default_rng(2).standard_normal((30, 5))
    target = matrix @ np.array([1.0, -2.0, 0.5, 3.0, -0.1])
    problem = linear(matrix, target, allowed=not_below_zero)
    found = minimise(
        problem, np.array([1.0, 0.0, 1.0, 1.0, 0.0]), np.zeros(5), np.full(5, 0.37), CRITERIA
    )
    assert np.allclose(found.parameters, nnls(matrix, target)[0], atol=1e-9)
    assert np.all(found.parameters >= 0)


def test_a_region_where_the_model_cannot_run_is_stepped_around():
    """Rosenbrock's valley with infinite cost on one side: the trust region shrinks and goes on."""
    problem = FromFunctions(
        lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]),
        lambda p: np.array([[-20 * p[0], 10], [-1, 0]]),
        allowed=lambda p: p[1] <= 1.6,
    )
    found = minimise(problem, np.array([-1.2, 1.0]), np.full(2, -np.inf), np.ones(2), CRITERIA)
    assert np.allclose(found.parameters, [1, 1], atol=1e-5)


def test_the_stop_reason_names_the_criterion():
    reasons = {
        (1e-3, 1e-12, 50): "tol1 = 0.001 (identification.cost_tolerance",
        (1e-15, 1e-15, 2): "max_iterations = 2",
    }
    for criteria, says in (reasons | {(0.0, 0.0, 200): "no step lowers the cost"}).items():
        found = minimise(
            exponential(), np.array([0.5, 4.0]), np.zeros(2), np.ones(2), StopCriteria(*criteria)
        )
        assert says in found.stop_reason
        assert found.iterations <= criteria[2]


INERTIAS = slice(1, 4)


def test_a_step_follows_the_curve_of_possible_bodies_to_the_optimum_of_linear_data():
    """Without a curve, the first step of a linear problem ends at its optimum. Here it also does,
    and a second run of the problem confirms it."""
    layout = rss6().with_full_bodies(["platform"]).layout
    seen = np.ones(len(layout.names))
    seen[layout.body_slices[0]] = 25.0, 0.4, -0.3, 0.2, 0.18, 0.17, 0.34, 0.02, 0.0, -0.01
    bounds = parameter_bounds(StartingGuess(layout, seen, 0.3 * seen), physical=True)
    start = seen * np.random.default_rng(1).uniform(0.8, 1.2, len(seen))
    matrix = np.diag(1e3 / seen.clip(0.01))
    coordinates = bounds.coordinates(bounds.nearest(start))
    found = minimise_in_coordinates(
        linear(matrix, matrix @ seen), bounds, coordinates, np.ones(len(seen)), CRITERIA
    )
    assert found.evaluations <= 3
    assert np.allclose(bounds.parameters(found.parameters), seen, rtol=1e-6, atol=1e-6)


def fitted(matrix, data, bounds, start) -> BoundedEstimate:
    found = minimise_in_coordinates(
        linear(matrix, data), bounds, bounds.coordinates(start), np.ones(len(start)), CRITERIA
    )
    estimate, information = bounds.parameters(found.parameters), matrix.T @ matrix
    gradient = matrix.T @ (matrix @ estimate - data)
    covariance = np.linalg.inv(information)
    return bounded_estimate(estimate, found.at_bound, gradient, covariance, covariance, bounds)


def one_bounds(physical):
    return parameter_bounds(guess_of(np.ones(67), np.ones(67)), physical)


@pytest.mark.parametrize("seed", range(6))
def test_the_constrained_optimum_is_the_one_that_scipy_finds(seed):
    """SLSQP with the inequalities in the moments themselves, of a platform that breaks one of them,
    the others held near one by their own rows; where no inequality is in the way both searches
    agree."""
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((9, 4))
    whole = block_diag(matrix, np.eye(63))

    def platform(target, physical):
        bounds = one_bounds(physical)
        return fitted(
            whole, whole @ np.append(target, np.ones(63)), bounds, bounds.nearest(np.ones(67))
        )

    target = np.array([2.0, *rng.permutation([0.4, 0.7, 1.9])])
    found, free = (platform(target, physical) for physical in (True, False))
    own = minimize(
        lambda x: np.sum((matrix @ (x - target)) ** 2),
        np.ones(4),
        method="SLSQP",
        bounds=[(1e-3, None), *[(0, None)] * 3],
        constraints={"type": "ineq", "fun": lambda x: x[INERTIAS].sum() - 2 * x[INERTIAS]},
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    assert np.allclose(found.estimate[:4], own.x, atol=2e-6), (found.estimate[:4], own.x)
    assert len(found.active_bounds) >= 1
    assert all(name.startswith("platform.I") for name in found.active_bounds)
    assert np.allclose(free.estimate[:4], target, atol=1e-6)
    with pytest.raises(UnphysicalInertiaError, match="platform"):
        physical_inertias(LAYOUT, free.estimate)
    held, free = (platform([2.0, 0.8, 0.9, 1.0], physical) for physical in (True, False))
    assert np.allclose(held.estimate, free.estimate, atol=1e-9)
    assert held.active_bounds == free.active_bounds == ()


@pytest.mark.slow
@pytest.mark.parametrize(("moment", "refused"), [(0.34, False), (0.37, True)])
def test_a_full_body_that_the_data_refuse_is_flat_and_keeps_the_estimate_without_bounds(
    moment, refused
):
    """The data see a platform whose largest moment may exceed the sum of the other two. In a linear
    problem the estimate without bounds is what the data see."""
    rng = np.random.default_rng(4)
    layout = rss6().with_full_bodies(["platform"]).layout
    own = layout.body_slices[0]
    seen = np.ones(len(layout.names))
    seen[own] = 25.0, 0.4, -0.3, 0.2, 0.18, 0.17, moment, 0.02, 0.0, -0.01
    bounds = parameter_bounds(StartingGuess(layout, seen, 0.3 * seen), physical=True)
    rows = rng.standard_normal((30, 10)) / np.array([5.0, *3 * [0.4], *6 * [0.05]])
    matrix = block_diag(rows / 0.03, np.eye(len(seen) - 10))
    start = seen.copy()
    start[own.start + 6] = 0.3
    found = fitted(matrix, matrix @ seen, bounds, bounds.nearest(start))
    assert np.allclose(found.unheld, seen, atol=1e-4 * np.abs(seen).max())
    # Among bodies that can exist the optimum is the one whose gradient a positive semidefinite
    # matrix Z balances, with Z L = 0 for the pseudo-inertia L.
    body = pseudo_inertia(found.estimate[own])
    units = pseudo_inertia(np.eye(10))
    pairs = np.triu_indices(4)
    weights = np.where(pairs[0] == pairs[1], 1.0, 2.0)
    gradient = (matrix.T @ matrix @ (found.estimate - seen))[own]
    balance = np.zeros((4, 4))
    balance[pairs] = np.linalg.solve(units[:, pairs[0], pairs[1]] * weights, gradient)
    balance += np.triu(balance, 1).T
    largest = np.abs(balance).max() + 1e-300
    assert np.linalg.eigvalsh(body).min() > 0
    assert np.linalg.eigvalsh(balance).min() > -1e-3 * max(largest, 1.0)
    assert np.abs(balance @ body).max() < 1e-3 * max(largest, 1.0)
    assert found.active_bounds == (("pseudo-inertia of platform > 0",) if refused else ())
    away = np.linalg.norm(matrix @ (found.estimate - seen))
    said = f"pseudo-inertia of platform > 0 ({away:.2g})"
    assert [said in text for text in found.warnings()] == [True] * refused


def test_the_nearest_parameters_are_within_the_bounds_and_physical_ones_stay():
    """The paper's starting values break the triangle inequality; the motion does not feel what is
    changed.
    """
    initial = rss6().parameter_sets["guess"].vector
    bounds = parameter_bounds(guess_of(initial, initial), physical=True)
    near = bounds.nearest(initial)
    physical_inertias(LAYOUT, near)
    changed = {NAMES[k] for k in np.flatnonzero(np.abs(near - initial) > 1e-9)}
    assert changed
    assert changed <= {
        f"{body}{leg}.{moment}"
        for leg in range(1, 7)
        for body, moment in (("crank", "Ixx"), ("crank", "Iyy"), ("link", "Izz"))
    }
    assert np.allclose(bounds.nearest(near), near, rtol=1e-12)
    plain = parameter_bounds(guess_of(initial, initial), physical=False)
    assert np.array_equal(plain.nearest(initial), initial)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (2, 3))]
)
def test_bodies_that_exist_are_identified_as_such(seed):
    """With noise the plain search finds bodies that cannot exist; the other does not, and fits as
    well. Its intervals hold what those without bounds hold, which a linearisation predicts to a
    fifth of a standard deviation."""
    flat = truth()
    bodies = physical_inertias(LAYOUT, flat, allow_changes=True).values
    flat[LAYOUT.rigid] = LAYOUT.rigid_of(bodies)
    # just below Ixx + Iyy, as of a plate
    flat[NAMES.index("platform.Izz")] = 0.999 * flat[1:3].sum()
    scenario = quick(**{"identification.method": "command_driven"})
    consistent = scenario.with_overrides({"identification.physical_consistency": True})
    record, _ = run_plant(scenario, seed=seed, parameters=flat)
    plain, physical = identify(record, rss6(), scenario), identify(record, rss6(), consistent)
    with pytest.raises(UnphysicalInertiaError):
        physical_inertias(LAYOUT, plain.estimate)
    physical_inertias(LAYOUT, physical.estimate)
    assert physical.active_bounds
    assert any("held at" in warning for warning in physical.warnings)
    low, high = physical.intervals.T
    known, slack = physical.identifiable, 0.2 * physical.std
    assert np.all((low >= 0) & (low <= physical.estimate) & (physical.estimate <= high))
    outer = plain.estimate + np.outer([-1.96, 1.96], physical.std)
    assert np.all((low <= np.maximum(outer[0], 0) + slack)[known])
    assert np.all((high >= outer[1] - slack)[known])
    assert physical.noise_ratio < plain.noise_ratio + 0.005
    assert load_scenario("paper").identification.physical_consistency is False


def not_negative(size):
    statements = tuple(f"p{k} >= 0" for k in range(size))
    return ParameterBounds(LAYOUT, np.eye(size), np.zeros(size), statements, physical=False)


def coverage(estimates, truth, rows, intervals):
    """Share (n,) of the estimates whose intervals of rows (n, p) @ parameters hold the true
    values."""
    ends = np.array([intervals(one, rows) for one in estimates])
    true = rows @ truth
    return np.mean((ends[:, :, 0] <= true) & (true <= ends[:, :, 1]), axis=0)


@pytest.mark.parametrize("distance", [0.0, 0.5, 1.5])
def test_correlated_parameters_near_their_bounds_are_covered(distance):
    """Five unknowns that the data tie together, three of them within some of their standard
    deviations of zero.
    """
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((12, 5)) + 1.5
    std = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))
    truth = std * np.array([distance, distance, distance, 5.0, 20.0])
    rows = np.vstack([np.eye(5), np.ones(5), rng.uniform(0, 1, 5), [1, -1, 0, 0, 0]])
    bounds = not_negative(5)
    estimates = [
        fitted(matrix, matrix @ truth + rng.standard_normal(12), bounds, truth)
        for _ in range(DRAWS)
    ]
    assert 0.05 < np.mean([one.at_bound[0] for one in estimates]) < 0.95
    found = coverage(estimates, truth, rows, BoundedEstimate.intervals)
    assert np.all(found >= LOWEST), found


def test_a_sum_of_many_at_their_bounds_is_covered_where_the_cut_interval_of_the_estimate_is_not():
    """Thirty independent unknowns that are zero: what is drawn below is raised, and so their sum is
    far too high.
    """
    rng = np.random.default_rng(1)
    size, bounds, rows = 30, not_negative(30), np.ones((1, 30))
    data = rng.standard_normal((DRAWS, size))
    one = np.eye(size)
    estimates = [
        bounded_estimate(np.maximum(y, 0), y < 0, np.maximum(-y, 0), one, one, bounds) for y in data
    ]

    def cut(found, rows):
        half, value = 1.96 * np.sqrt(size), rows @ found.estimate
        return np.stack([np.maximum(value - half, 0), value + half], axis=1)

    assert coverage(estimates, np.zeros(size), rows, cut)[0] < 0.6
    assert coverage(estimates, np.zeros(size), rows, BoundedEstimate.intervals)[0] >= LOWEST


def body_fit(physical):
    """67 parameters near one whose platform has Izz > Ixx + Iyy, from noisy data."""
    rng = np.random.default_rng(0)
    truth = np.ones(67)
    truth[1:4] = 1.0, 1.0, 2.6
    matrix = np.vstack([rng.standard_normal((70, 67)), 3 * np.eye(67)])
    data = matrix @ truth + 0.3 * rng.standard_normal(len(matrix))
    bounds = one_bounds(physical)
    return fitted(matrix, data, bounds, bounds.nearest(np.ones(67))), np.linalg.lstsq(matrix, data)[
        0
    ]


def test_intervals_end_at_the_bounds_and_hold_the_estimate_and_how_far_a_bound_moved_it_is_a_warning():
    found, unbounded = body_fit(physical=True)
    wide = replace(found, covariance=100 * found.covariance, white=100 * found.white)
    for one in (found, wide):
        intervals = one.intervals(np.eye(67))
        assert np.all(intervals[:, 0] >= 0)
        assert np.all((intervals[:, 0] <= one.estimate) & (one.estimate <= intervals[:, 1]))
    platform = wide.intervals(np.eye(67))[index_of("platform.mass")]
    assert platform[0] == pytest.approx(1e-3), "the model needs a thousandth of the guess"
    assert found.active_bounds
    assert np.allclose(found.unheld, unbounded, atol=1e-8)
    row = np.zeros(67)
    row[INERTIAS] = 0.5, 0.5, -0.5
    beyond = -(row @ unbounded) / np.sqrt(row @ found.covariance @ row)
    assert beyond > 1
    said = found.warnings()[0]
    assert f"platform.Izz <= Ixx + Iyy ({beyond:.2g})" in said
    assert "\n" not in said
    # Where no bound is near, estimate and interval are the usual ones.
    found, unbounded = body_fit(physical=False)
    assert not found.active_bounds
    assert np.allclose(found.unheld, unbounded, atol=1e-8)
    row = np.random.default_rng(0).standard_normal((1, 67))
    std = np.sqrt(row @ found.covariance @ row.T)[0, 0]
    assert found.intervals(row)[0] == pytest.approx(
        (row @ found.estimate)[0] + 1.959964 * std * np.array([-1, 1])
    )
    assert found.warnings() == ()
