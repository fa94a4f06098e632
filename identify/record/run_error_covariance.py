"""Covariances of errors that are constant during a run.

These functions check a covariance, factor it, and find the directions of the errors with a
noticeable effect on the poses.
"""

import numpy as np

from identify.arrays import Array

# Effect below which a direction of the errors is omitted. The effect is the norm over all frames,
# in standard deviations of the noise.
NOTICED = 0.1
# Largest asymmetry or negative eigenvalue of a correlation matrix that counts as rounding.
ROUNDING = 1e-9


def covariance_fault(covariance: Array) -> str:
    """Return why a matrix (k, k) is not a covariance, or an empty string. Variances must be > 0."""
    if not np.isfinite(covariance).all():
        return "is not finite"
    if not (np.diag(covariance) > 0.0).all():
        return "is not a covariance: it has a variance that is not > 0"
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    if np.abs(unit - unit.T).max() > ROUNDING:
        return "is not a covariance: it is not symmetric"
    least = float(np.linalg.eigvalsh(unit)[0])
    if least < -ROUNDING:
        return f"is not a covariance: its correlations have the negative eigenvalue {least:.2g}"
    return ""


def factor(covariance: Array) -> Array:
    """Return a factor L (k, k) with L L^T equal to a covariance."""
    std = np.sqrt(np.diag(covariance))
    # Correlations are decomposed, because eigenvalues of mixed units (m2 and rad2) would lose
    # digits.
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    return np.asarray(std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def noticed_directions(root: Array, seen: Array) -> tuple[Array, int]:
    """Rotate a factor of a covariance so that the effects of its columns are orthogonal.

    root (k, k)    Factor of the covariance.
    seen (..., k)  Effect of each column on the measurements, in standard deviations of their noise.

    Returns the rotated factor (k, k), with the most noticed direction first, and the number of
    noticed directions, whose effect is above NOTICED.
    """
    sizes, turns = np.linalg.svd(np.linalg.qr(seen.reshape(-1, len(root)), mode="r"))[1:]
    return np.asarray(root @ turns.T), int(np.sum(sizes > NOTICED))
