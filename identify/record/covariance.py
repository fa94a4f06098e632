"""Covariances of errors that are one draw a run: is one valid, its factor, the directions that
poses notice.
"""

import numpy as np

from identify.arrays import Array

NOTICED = 0.1
"""Standard deviations of the noise of all frames together, below which a direction of the errors is
left out.
"""
ROUNDING = 1e-9


def covariance_fault(covariance: Array) -> str:
    """Why a matrix (k, k) is no covariance with variances above zero; empty where it is one."""
    if not np.isfinite(covariance).all():
        return "is not finite"
    if not (np.diag(covariance) > 0.0).all():
        return "is no covariance: it has a variance that is not > 0"
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    if np.abs(unit - unit.T).max() > ROUNDING:
        return "is no covariance: it is not symmetric"
    least = float(np.linalg.eigvalsh(unit)[0])
    return (
        f"is no covariance: as correlations it has the eigenvalue {least:.2g}, < 0"
        if least < -ROUNDING
        else ""
    )


def factor(covariance: Array) -> Array:
    """L (k, k) with L L^T a covariance."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    return np.asarray(std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def noticed_directions(root: Array, seen: Array) -> tuple[Array, int]:
    """Another factor (k, k) of the covariance that `root` is one of, whose columns are independent
    directions, the most noticed ones first, and how many of them are noticed; seen (..., k): what
    the columns of `root` do to what is measured, in standard deviations of its noise."""
    sizes, turns = np.linalg.svd(np.linalg.qr(seen.reshape(-1, len(root)), mode="r"))[1:]
    return np.asarray(root @ turns.T), int(np.sum(sizes > NOTICED))
