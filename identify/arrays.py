"""Array type of this package, QR factor of tall matrices, and rounding to a common grid."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

BLOCK = 600
"""Number of rows that are factored at once.

With as many columns as there are parameters, a block fits into a processor's cache.
"""


def triangular_factor(*parts: Array) -> Array:
    """Return the triangular factor R of the QR factorisation of a tall matrix (n, p).

    The columns are given in one or more parts (n, q) or (n,) side by side. The signs of its rows
    are arbitrary. Factoring block by block takes half the time of a factorisation at once.

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


def agreed(values: ArrayLike, bits: int = 27) -> Array:
    """Round an array to `bits` bits of its largest entry, on which all processors agree.

    The default keeps a relative resolution of some 1e-8. Kernels of BLAS and vectorised sines
    differ in the last bits from one processor to another. A search that begins with numbers on a
    grid takes the same steps on all of them. The spacing is a power of two, so that rounding is
    exact. A number whose last bits differ across the edge between two grid points is rounded apart.
    With fewer bits than the number is exact to, that hardly ever happens.

    Examples
    --------
    >>> agreed([1.0, 0.1 + 1e-12], bits=20) == agreed([1.0, 0.1], bits=20)
    array([ True,  True])
    """
    array = np.asarray(values, dtype=float)
    largest = float(np.abs(array).max(initial=0.0))
    if largest == 0.0 or not np.isfinite(largest):
        return array
    grid = 2.0 ** (round(math.log2(largest)) - bits)
    return np.asarray(np.rint(array / grid) * grid + 0.0)  # no zero is negative
