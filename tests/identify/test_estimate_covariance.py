"""The covariance of an estimate whose information no computer can invert, against closed forms."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from identify.estimation.covariance import estimate_uncertainty

FRAMES, SIZE = 40, 12
SINGULAR = np.logspace(10, -2, SIZE)
"""Of the Jacobian, in units of the starting guess's deviations: the information spans 20 orders of magnitude."""


def orthogonal(rng, rows, columns):
    return np.linalg.qr(rng.standard_normal((rows, columns)))[0]


@pytest.fixture
def problem():
    """A linear problem J = U diag(SINGULAR) V^T whose guess is known to one in each direction; returns it and V."""
    rng = np.random.default_rng(0)
    left, right = orthogonal(rng, 6 * FRAMES, SIZE), orthogonal(rng, SIZE, SIZE)
    jacobian = (left * SINGULAR @ right.T).reshape(FRAMES, 6, SIZE)
    noise = rng.standard_normal((FRAMES, 6))

    def of(size):
        run = SimpleNamespace(
            residuals=lambda parameters: (size * noise, jacobian),
            driven=True,
            ok=np.ones(FRAMES, dtype=bool),
            payload_std=np.zeros(SIZE),
        )
        return SimpleNamespace(runs=(run,), known=lambda parameters: (np.zeros(SIZE), np.eye(SIZE)))

    return of, right


def uncertainty(problem):
    with warnings.catch_warnings(action="error"):
        return estimate_uncertainty(problem, np.zeros(SIZE), np.random.default_rng(0))


def test_it_is_the_inverse_of_the_information_where_noise_is_all(problem):
    of, right = problem
    found = uncertainty(of(0.9))
    assert not found.misfit.significant
    assert np.linalg.cond(found.information + np.eye(SIZE)) > 1e15
    expected = right / (1 + SINGULAR**2) @ right.T
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-5, atol=1e-7)


def test_a_model_that_misses_the_record_a_million_times_over_leaves_variances_that_are_positive(problem):
    """A starting guess that is all there is knows its parameter no better than it says; no residual takes from that."""
    of, right = problem
    found = uncertainty(of(1e3))
    assert found.misfit.decides
    assert np.linalg.eigvalsh(found.covariance)[0] > -1e-9 * np.linalg.eigvalsh(found.covariance)[-1]
    unseen = SINGULAR < 0.1
    assert np.all(np.diag(right[:, unseen].T @ found.covariance @ right[:, unseen]) > 0.98)
    assert np.all(np.diag(found.covariance) > 0)
