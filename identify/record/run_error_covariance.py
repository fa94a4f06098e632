"""Covariances of errors that are drawn once a run.

These functions check a covariance, factor it, and find the directions of the errors that poses
notice.
"""

import numpy as np

from identify.arrays import Array

NOTICED = 0.1
"""Effect below which a direction of the errors is left out.

Its unit is the standard deviation of the noise of all frames together.
"""
ROUNDING = 1e-9
"""Asymmetry, or size of a negative eigenvalue, of correlations that counts as rounding."""


def covariance_fault(covariance: Array) -> str:
    """Return why a matrix (k, k) is no covariance with variances > 0, or an empty string."""
    if not np.isfinite(covariance).all():
        return "is not finite"
    if not (np.diag(covariance) > 0.0).all():
        return "is no covariance: it has a variance that is not > 0"
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    if np.abs(unit - unit.T).max() > ROUNDING:
        return "is no covariance: it is not symmetric"
    least = float(np.linalg.eigvalsh(unit)[0])
    if least < -ROUNDING:
        return f"is no covariance: as correlations it has the eigenvalue {least:.2g}, < 0"
    return ""


def factor(covariance: Array) -> Array:
    """Return a factor L (k, k) with L L^T equal to a covariance."""
    std = np.sqrt(np.diag(covariance))
    # correlations: eigenvalues of m2 and rad2 side by side would lose digits
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    return np.asarray(std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def noticed_directions(root: Array, seen: Array) -> tuple[Array, int]:
    """Turn a factor of a covariance so that its columns are independent directions.

    Parameters
    ----------
    root : ndarray, shape (k, k)
        Factor of the covariance.
    seen : ndarray, shape (..., k)
        Effect of its columns on the measurements, in standard deviations of their noise.

    Returns
    -------
    tuple of ndarray, shape (k, k), and int
        Another factor, with the most noticed direction first, and the number of noticed directions.
    """
    sizes, turns = np.linalg.svd(np.linalg.qr(seen.reshape(-1, len(root)), mode="r"))[1:]
    return np.asarray(root @ turns.T), int(np.sum(sizes > NOTICED))
