"""Compiled: small symmetric systems of equations, where a call of LAPACK costs more than the work."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import compiled

SMALLEST_PIVOT = 1e-300


@compiled
def factor(matrix: np.ndarray) -> None:
    """Cholesky factor of a symmetric matrix (n,n), in its lower triangle."""
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(max(rest, SMALLEST_PIVOT)) if i == j else rest / matrix[j, j]


@compiled
def solve_factored(lower: np.ndarray, right: np.ndarray) -> None:
    """Solve L L' x = right (n,) in place."""
    n = len(right)
    for i in range(n):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]


@compiled
def invert_factored(lower: np.ndarray, inverse: np.ndarray) -> None:
    """Fill ``inverse``, the leading (m,m) part of the inverse of L L'."""
    column = np.empty(len(lower))
    for k in range(len(inverse)):
        column[:] = 0.0
        column[k] = 1.0
        solve_factored(lower, column)
        for i in range(len(inverse)):
            inverse[i, k] = column[i]
