"""Intervals within bounds: they hold the truth as often as they say, however many bounds hold the estimate.

The linear problems have known statistics: the estimate without bounds is that of `numpy.linalg.lstsq`.
"""

import numpy as np
import pytest

from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.bounds import (
    BoundedEstimate,
    InCoordinates,
    ParameterBounds,
    bounded_estimate,
    parameter_bounds,
)
from identify.loop_parameters import StartingGuess, index_of

CRITERIA = StopCriteria(1e-12, 1e-9, 200)
DRAWS = 500
LOWEST = 0.95 - 3 * np.sqrt(0.95 * 0.05 / DRAWS)
"""What chance makes of 95 % in so many draws, in one of a thousand tests."""


class Linear:
    def __init__(self, matrix, data):
        self.matrix, self.data = matrix, data

    def cost(self, parameters):
        return float(np.sum((self.matrix @ parameters - self.data) ** 2))

    def linearise(self, parameters):
        size, residual = len(parameters), self.matrix @ parameters - self.data
        factor = np.linalg.qr(np.column_stack([self.matrix, residual]), mode="r")
        return float(residual @ residual), factor[:size, :size], factor[:size, size]


def fitted(matrix, data, bounds, start) -> BoundedEstimate:
    problem = Linear(matrix, data)
    found = minimise(
        InCoordinates(problem, bounds), bounds.coordinates(start), bounds.lower, np.ones(len(start)), CRITERIA
    )
    estimate, information = bounds.parameters(found.parameters), matrix.T @ matrix
    gradient = matrix.T @ (matrix @ estimate - data)
    return bounded_estimate(estimate, found.at_bound, gradient, information, np.linalg.inv(information), bounds)


def not_negative(size):
    return ParameterBounds(np.eye(size), np.zeros(size), tuple(f"p{k} >= 0" for k in range(size)), physical=False)


def coverage(estimates, truth, rows, intervals):
    """Share (n,) of the estimates whose intervals of rows (n, p) @ parameters hold the true values."""
    ends = np.array([intervals(one, rows) for one in estimates])
    true = rows @ truth
    return np.mean((ends[:, :, 0] <= true) & (true <= ends[:, :, 1]), axis=0)


@pytest.mark.parametrize("distance", [0.0, 0.5, 1.5])
def test_correlated_parameters_near_their_bounds_are_covered(distance):
    """Five unknowns that the data tie together, three of them within some of their standard deviations of zero."""
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((12, 5)) + 1.5
    std = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))
    truth = std * np.array([distance, distance, distance, 5.0, 20.0])
    rows = np.vstack([np.eye(5), np.ones(5), rng.uniform(0, 1, 5), [1, -1, 0, 0, 0]])
    bounds = not_negative(5)
    estimates = [fitted(matrix, matrix @ truth + rng.standard_normal(12), bounds, truth) for _ in range(DRAWS)]
    assert 0.05 < np.mean([one.at_bound[0] for one in estimates]) < 0.95
    found = coverage(estimates, truth, rows, BoundedEstimate.intervals)
    assert np.all(found >= LOWEST), found


def test_a_sum_of_many_at_their_bounds_is_covered_where_the_cut_interval_of_the_estimate_is_not():
    """Thirty independent unknowns that are zero: what is drawn below is raised, and so their sum is far too high."""
    rng = np.random.default_rng(1)
    size, bounds, rows = 30, not_negative(30), np.ones((1, 30))
    data = rng.standard_normal((DRAWS, size))
    one = np.eye(size)
    estimates = [bounded_estimate(np.maximum(y, 0), y < 0, np.maximum(-y, 0), one, one, bounds) for y in data]

    def cut(found, rows):
        half, value = 1.96 * np.sqrt(size), rows @ found.estimate
        return np.stack([np.maximum(value - half, 0), value + half], axis=1)

    assert coverage(estimates, np.zeros(size), rows, cut)[0] < 0.6
    assert coverage(estimates, np.zeros(size), rows, BoundedEstimate.intervals)[0] >= LOWEST


def body_fit(seed, physical):
    """67 parameters near one whose platform has Izz > Ixx + Iyy, from noisy data."""
    rng = np.random.default_rng(seed)
    truth = np.ones(67)
    truth[1:4] = 1.0, 1.0, 2.6
    matrix = np.vstack([rng.standard_normal((70, 67)), 3 * np.eye(67)])
    data = matrix @ truth + 0.3 * rng.standard_normal(len(matrix))
    bounds = parameter_bounds(StartingGuess(np.ones(67), np.ones(67)), physical)
    return fitted(matrix, data, bounds, bounds.nearest(np.ones(67))), np.linalg.lstsq(matrix, data)[0]


@pytest.mark.parametrize("physical", [False, True])
def test_the_unheld_estimate_is_that_of_the_problem_without_bounds(physical):
    found, unbounded = body_fit(0, physical)
    assert bool(found.active_bounds) == physical
    assert np.allclose(found.unheld, unbounded, atol=1e-8)


def test_intervals_end_at_the_bounds_and_hold_the_estimate():
    found, _ = body_fit(1, physical=True)
    wide = BoundedEstimate(found.estimate, found.at_bound, found.unheld, 100 * found.covariance, found.bounds)
    for one in (found, wide):
        intervals = one.intervals(np.eye(67))
        assert np.all(intervals[:, 0] >= 0)
        assert np.all((intervals[:, 0] <= one.estimate) & (one.estimate <= intervals[:, 1]))
    platform = wide.intervals(np.eye(67))[index_of("platform.mass")]
    assert platform[0] == pytest.approx(1e-3), "the model needs a thousandth of the guess"


def test_where_no_bound_is_near_the_interval_is_the_usual_one():
    found, _ = body_fit(0, physical=False)
    row = np.random.default_rng(0).standard_normal((1, 67))
    std = np.sqrt(row @ found.covariance @ row.T)[0, 0]
    assert found.intervals(row)[0] == pytest.approx((row @ found.estimate)[0] + 1.959964 * std * np.array([-1, 1]))
    assert found.warnings() == ()


def test_the_warning_names_bound_and_distance():
    found, unbounded = body_fit(0, physical=True)
    said = found.warnings()[0]
    back, row = np.array([0.5, 0.5, -0.5]), np.zeros(67)
    row[1:4] = back
    beyond = -(row @ unbounded) / np.sqrt(row @ found.covariance @ row)
    assert f"platform.Izz <= Ixx + Iyy ({beyond:.2g})" in said
    assert beyond > 1
    assert "\n" not in said
