"""Array type of this package, QR factor of tall matrices, normalised errors, and rounding."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Number of rows of a block. A matrix with up to twice as many rows is one block. A block with one
# column per parameter fits into the cache of a processor.
BLOCK = 600

# Variance, in units of those of the quantities, up to which a direction counts as one without a
# variance. Rounding leaves some 1e-15.
LEAST_VARIANCE = 1e-12


def triangular_factor(*parts: Array) -> Array:
    """Return the triangular factor R of the QR factorisation of a tall matrix (n, p).

    The columns are given in one or more parts (n, q) or (n,) side by side. The signs of the rows of
    R are arbitrary. Factoring block by block takes half the time of a single factorisation.

    References
    ----------
    Demmel, Grigori, Hoemmen and Langou, Communication-optimal parallel and sequential QR and LU
    factorizations, SIAM Journal on Scientific Computing 34(1), 2012.
    """
    count = len(parts[0])
    step = BLOCK if count > 2 * BLOCK else max(count, 1)
    blocks = [
        np.linalg.qr(np.column_stack([part[first : first + step] for part in parts]), mode="r")
        for first in range(0, max(count, 1), step)
    ]
    return np.asarray(blocks[0] if len(blocks) == 1 else np.linalg.qr(np.vstack(blocks), mode="r"))


def normalised_square(errors: Array, covariances: Array) -> float:
    """Return the mean of e^T P^-1 e / m over N errors e (N, m) with covariances P (N, m, m).

    Where P is singular, only the directions with a variance count. The result is NaN if P is.
    """
    if np.isnan(covariances).any():
        return np.nan
    # In units of the standard deviations, quantities of different units are comparable.
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    unit = np.where(std > 0, std, 1.0)
    variances, axes = np.linalg.eigh(covariances / (unit[:, :, None] * unit[:, None, :]))
    along = np.einsum("nij,ni->nj", axes, errors / unit)
    uncertain = variances > LEAST_VARIANCE
    squared = np.divide(along**2, variances, out=np.zeros_like(along), where=uncertain)
    return float(squared.sum() / max(uncertain.sum(), 1))


def agreed(values: ArrayLike, bits: int = 27) -> Array:
    """Round an array to about `bits` bits of its largest entry, so that processors agree.

    The default resolution is about 1e-8 of the largest entry. Kernels of BLAS and vectorised sines
    differ in the last bits from processor to processor. A search that begins with rounded numbers
    takes the same steps on all processors. The spacing of the grid is a power of two, so grid
    points are exact. Two processors disagree only if their values lie on different sides of the
    middle between two grid points, which is very rare on a coarse grid. An array of zeros, or with
    an entry that is not finite, is returned unchanged.
    """
    array = np.asarray(values, dtype=float)
    largest = float(np.abs(array).max(initial=0.0))
    if largest == 0.0 or not np.isfinite(largest):
        return array
    grid = 2.0 ** (round(math.log2(largest)) - bits)
    return np.asarray(np.rint(array / grid) * grid + 0.0)  # + 0.0 removes negative zeros
