"""The array type of this package, and what tall arrays are condensed to."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 600
"""Rows that are factored at once: with as many columns as parameters they fit into a processor's cache."""


def triangular_factor(*parts: Array) -> Array:
    """R of the QR factorisation of tall rows (n, p), given in one or more parts (n, q) or (n,) side by side, by blocks
    (Demmel, Grigori, Hoemmen and Langou, Communication-optimal parallel and sequential QR and LU factorizations, SIAM
    Journal on Scientific Computing 34(1), 2012): half the time of that at once. Its rows may have the other sign."""
    count = len(parts[0])
    step = BLOCK if count > 2 * BLOCK else max(count, 1)
    blocks = [
        np.linalg.qr(np.column_stack([part[first : first + step] for part in parts]), mode="r")
        for first in range(0, max(count, 1), step)
    ]
    return np.asarray(blocks[0] if len(blocks) == 1 else np.linalg.qr(np.vstack(blocks), mode="r"))
