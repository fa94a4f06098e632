"""Small dense linear algebra, and the rows of derivatives that follow it: one row an unknown, one column a variable."""

import numpy as np

from dynamics.compiled.kernel import Array, kernel, part


@part
def cholesky(matrix: Array, size: int, factor: Array) -> bool:
    """Factor L (size, size) of a symmetric matrix, with the reciprocals of its diagonal; False if it has none."""
    for i in range(size):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = left * factor[j, j]
            elif left > 0:
                factor[i, i] = 1 / np.sqrt(left)
            else:
                return False
    return True


@part
def solve(factor: Array, size: int, vector: Array) -> None:
    """Solve L L^T x = vector (size,) in place."""
    for i in range(size):
        left = vector[i]
        for k in range(i):
            left -= factor[i, k] * vector[k]
        vector[i] = left * factor[i, i]
    for i in range(size - 1, -1, -1):
        left = vector[i]
        for k in range(i + 1, size):
            left -= factor[k, i] * vector[k]
        vector[i] = left * factor[i, i]


@part
def dot(row: Array, vector: Array) -> float:
    """Scalar product, summed in order."""
    total = 0.0
    for j in range(len(row)):
        total += row[j] * vector[j]
    return total


@part
def copy(source: Array, into: Array) -> None:
    """Copy a vector. Assigning slices would do it in numba, too, and take a second to compile."""
    for k in range(len(source)):
        into[k] = source[k]


@part
def fill(into: Array, value: float) -> None:
    """Set all entries of a vector."""
    for k in range(len(into)):
        into[k] = value


@part
def clear(rows: Array, width: int) -> None:
    """Zero the columns in use of some rows."""
    for i in range(len(rows)):
        for k in range(width):
            rows[i, k] = 0.0


@part
def copy_rows(source: Array, into: Array, width: int) -> None:
    """Copy the columns in use of some rows."""
    for i in range(len(source)):
        for k in range(width):
            into[i, k] = source[i, k]


@part
def add_row(factor: float, row: Array, into: Array, width: int) -> None:
    """Add factor times a row of derivatives to another, over the columns in use."""
    for k in range(width):
        into[k] += factor * row[k]


@kernel
def add_product(scale: float, matrix: Array, rows: Array, into: Array, width: int) -> None:
    """Add scale times matrix (n, m) times rows (m, columns) to the rows `into` (n, columns)."""
    count, inner = matrix.shape
    for i in range(count):
        for j in range(inner):
            add_row(scale * matrix[i, j], rows[j], into[i], width)


@kernel
def solve_rows(factor: Array, size: int, rows: Array, width: int) -> None:
    """Solve L L^T x = rows (size, columns) in place."""
    for i in range(size):
        for k in range(i):
            add_row(-factor[i, k], rows[k], rows[i], width)
        for column in range(width):
            rows[i, column] *= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            add_row(-factor[k, i], rows[k], rows[i], width)
        for column in range(width):
            rows[i, column] *= factor[i, i]
