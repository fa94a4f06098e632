"""Covariance of the estimate when the residuals are coloured.

Sensor noise goes through the servo into the plant's motion, and a model that closes its own loop cannot follow it: the
residuals are white measurement noise plus a slow motion. With W the linearised problem's information (data and what
was known before), and B the sum of J_s^T C(t - s) J_t over the residuals' own autocovariance C, the covariance is
W^-1 (B + prior information) W^-1. C is estimated from the residuals, with Bartlett weights up to `MEMORY_S`.
"""

import numpy as np

from identify.arrays import Array

MEMORY_S = 1.0
"""Lag [s] up to which residuals are taken as correlated: several time constants of the servo loop."""


def parameter_covariance(factor: Array, residual: Array, jacobian: Array, rate_hz: float) -> Array:
    """Covariance (p, p) from the triangular factor (p, p) of data and prior, whitened residuals (n, 6), and their
    Jacobian (n, 6, p). Frames that were lost are left out of both; they are too few to matter for C."""
    inverse = np.linalg.inv(factor)
    flat = jacobian.reshape(-1, jacobian.shape[2])
    prior = factor.T @ factor - flat.T @ flat
    lags = min(round(MEMORY_S * rate_hz), len(residual) // 4)
    scores = coloured_information(residual, jacobian, lags)
    covariance = inverse @ inverse.T @ (scores + prior) @ inverse @ inverse.T
    return np.asarray((covariance + covariance.T) / 2, dtype=float)


def coloured_information(residual: Array, jacobian: Array, lags: int) -> Array:
    """Sum over |t - s| <= lags of J_s^T C(t - s) J_t (p, p), Bartlett weighted."""
    count = len(residual)
    total = np.zeros((jacobian.shape[2],) * 2)
    for lag in range(lags + 1):
        weight = 1 - lag / (lags + 1)
        autocovariance = residual[: count - lag].T @ residual[lag:] / count
        # (n, 6, p): C(lag) J_t, then contracted with J_s over frames and components at once.
        later = np.tensordot(jacobian[lag:], autocovariance, axes=(1, 1)).transpose(0, 2, 1)
        flat = later.reshape(-1, later.shape[2])
        term = jacobian[: count - lag].reshape(-1, jacobian.shape[2]).T @ flat
        total += weight * (term if lag == 0 else term + term.T)
    return total
