"""Linear propagation of uncertainty."""

import numpy as np

from identify.arrays import Array


def combined_std(rows: Array, covariance: Array) -> Array:
    """Standard deviations (n,) of the combinations rows (n, p) @ parameters, from the parameters' covariance (p, p)."""
    return np.asarray(np.sqrt(np.einsum("gi,ij,gj->g", rows, covariance, rows)))
