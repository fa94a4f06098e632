"""A normal distribution within bounds, beside the formula for one bound and drawn numbers."""

import numpy as np
import pytest
from scipy.stats import kstest, norm, truncnorm

from identify.estimation.truncated_normal import truncated


@pytest.mark.parametrize("lower", [-12.0, -3.0, 0.0, 4.0, 30.0, 500.0])
def test_one_bound_gives_the_moments_of_scipys_truncated_normal(lower):
    """Also far beyond the mean, where the plain formula has no digits left."""
    mean, std = np.array([1.0, 2.0]), np.array([2.0, 0.5])
    covariance = np.diag(std**2)
    covariance[0, 1] = covariance[1, 0] = 0.6
    found = truncated(mean, covariance, np.array([[3.0, 0.0]]), np.array([3 * lower]))
    exact = truncnorm((lower - 1) / 2, np.inf, 1.0, 2.0)
    near, spread = exact.mean(), exact.var()
    if lower > 100:  # scipy's variance has no digits here, and the series of the tail has
        beyond = (lower - 1) / 2
        near, spread = lower + 2 / beyond, 4 / beyond**2
    assert found.mean[0] == pytest.approx(near, rel=2e-5)
    assert found.covariance[0, 0] == pytest.approx(spread, rel=2e-3)
    # the other quantity follows by regression
    assert found.mean[1] == pytest.approx(2 + 0.15 * (found.mean[0] - 1), rel=1e-6)
    # before its own bound, the quantity has the distribution without bounds
    centre, own = found.marginals(np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert (centre[0], own[0]) == (pytest.approx(1.0, abs=1e-4), pytest.approx(2.0, rel=1e-4))


def test_several_bounds_of_correlated_quantities_give_the_moments_of_drawn_ones():
    """Five quantities that the data tie together, three of them near their bounds, and a sum."""
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(np.linalg.inv(np.cov(rng.standard_normal((5, 9)) + 1.0)))
    mean = np.array([0.3, -0.4, 0.2, 3.0, 1.0])
    directions = np.vstack([np.eye(5)[:3], [1.0, 1.0, 0.0, 0.0, -1.0]])
    lower = np.array([0.0, 0.0, -0.2, -2.0])
    drawn = mean + rng.standard_normal((2_000_000, 5)) @ root.T
    inside = drawn[np.all(drawn @ directions.T >= lower, axis=1)]
    assert len(inside) > 10_000
    found = truncated(mean, root @ root.T, directions, lower)
    std = inside.std(axis=0)
    assert np.abs((found.mean - inside.mean(axis=0)) / std).max() < 0.04
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=0.04)


def test_bounds_that_are_far_away_change_nothing():
    mean = np.array([10.0, 20.0])
    found = truncated(mean, np.eye(2), np.eye(2), np.zeros(2))
    assert np.array_equal(found.mean, mean)
    assert np.array_equal(found.covariance, np.eye(2))


def test_noise_beyond_the_stated_one_is_not_taken_for_knowledge_of_a_bound():
    """Truths from a prior that a bound truncates far from its mean, and estimates with the weights
    of noise that is a fifth of the true one. A simulation of all of it is the oracle.
    """
    rng = np.random.default_rng(2)
    rows, spread, lower = np.array([[1.1, 1.0], [-0.8, -0.7], [0.1, 0.2]]), 5.0, 1.5
    white = np.linalg.inv(np.eye(2) + rows.T @ rows)
    covariance = white @ (np.eye(2) + spread**2 * rows.T @ rows) @ white
    bound = np.array([[0.0, 1.0]]), np.array([lower])
    below: dict[str, list[float]] = {"apart": [], "together": []}
    for _ in range(1000):
        truth = np.array([rng.standard_normal(), truncnorm.rvs(lower, np.inf, random_state=rng)])
        estimate = white @ rows.T @ (rows @ truth + spread * rng.standard_normal(3))
        for name, found in (
            ("apart", truncated(estimate, white, *bound, covariance - white)),
            ("together", truncated(estimate, covariance, *bound)),
        ):
            centre, std = found.marginals(np.array([[1.0, 0.0]]))
            below[name].append(float(norm.cdf((truth[0] - centre[0]) / std[0])))
    assert kstest(below["apart"], "uniform").pvalue > 0.01
    assert kstest(below["together"], "uniform").pvalue < 1e-6
