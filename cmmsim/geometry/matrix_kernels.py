"""Compiled kernels for small symmetric systems of equations, by Cholesky factors or by minors."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled

# Smallest square of a diagonal entry of a Cholesky factor.
SMALLEST_PIVOT = 1e-300


@compiled
def factorise(matrix: Array) -> None:
    """Replace the lower triangle of a symmetric matrix (n, n) by its Cholesky factor L."""
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            # if rounding errors make the matrix indefinite, the diagonal entry is a tiny number
            matrix[i, j] = math.sqrt(max(rest, SMALLEST_PIVOT)) if i == j else rest / matrix[j, j]


@compiled
def solve_factored(lower: Array, right: Array) -> None:
    """Replace the right-hand side ``right`` (n,) by the solution x of L L' x = ``right``."""
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
def invert_factored(lower: Array, inverse: Array) -> None:
    """Fill ``inverse`` with the leading (m, m) part of the inverse of L L'.

    The inverse is K' K with K = L^-1.
    """
    n = len(lower)
    m = len(inverse)
    root = np.empty((n, m))
    for k in range(m):
        for i in range(k, n):
            rest = 1.0 if i == k else 0.0
            for j in range(k, i):
                rest -= lower[i, j] * root[j, k]
            root[i, k] = rest / lower[i, i]
        for i in range(k + 1):
            total = 0.0
            for j in range(k, n):
                total += root[j, i] * root[j, k]
            inverse[i, k] = inverse[k, i] = total


@compiled
def inverse_entries(n: Array, into: Array) -> None:
    """Fill ``into`` (6,) with the inverse of a symmetric matrix (3, 3) with entries ``n`` (6,).

    Both are given by the entries 00, 01, 02, 11, 12 and 22.
    """
    c_00 = n[3] * n[5] - n[4] * n[4]
    c_01 = n[2] * n[4] - n[1] * n[5]
    c_02 = n[1] * n[4] - n[2] * n[3]
    inverse_determinant = 1.0 / (n[0] * c_00 + n[1] * c_01 + n[2] * c_02)
    into[0] = inverse_determinant * c_00
    into[1] = inverse_determinant * c_01
    into[2] = inverse_determinant * c_02
    into[3] = inverse_determinant * (n[0] * n[5] - n[2] * n[2])
    into[4] = inverse_determinant * (n[1] * n[2] - n[0] * n[4])
    into[5] = inverse_determinant * (n[0] * n[3] - n[1] * n[1])


@compiled
def from_entries(entries: Array, matrix: Array) -> None:
    """Fill a symmetric matrix (3,3) from its entries 00, 01, 02, 11, 12 and 22."""
    matrix[0, 0] = entries[0]
    matrix[1, 1] = entries[3]
    matrix[2, 2] = entries[5]
    matrix[0, 1] = matrix[1, 0] = entries[1]
    matrix[0, 2] = matrix[2, 0] = entries[2]
    matrix[1, 2] = matrix[2, 1] = entries[4]


@compiled
def square_by(n: Array, x: float, y: float, z: float) -> float:
    """Return v' N v for v = (x, y, z) and the symmetric matrix N with entries ``n`` (6,)."""
    squared = n[0] * x * x + n[3] * y * y + n[5] * z * z
    return squared + 2.0 * (n[1] * x * y + n[2] * x * z + n[4] * y * z)
