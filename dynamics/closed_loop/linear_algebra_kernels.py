"""Small dense linear algebra, for vectors and for rows of derivatives.

Each row holds the derivatives of one unknown, and each column those with respect to one variable.
`width` is the number of columns in use.
"""

from dynamics.compiled.kernel import Array, add_row, kernel, part


@part
def factorise(matrix: Array, size: int, factor: Array) -> None:
    """Factorise a symmetric matrix (size, size) into L D L^T.

    `factor` has L below its diagonal, 1/D on it, and D L^T above it.
    """
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[k, j]
            factor[j, i] = rest
            factor[i, j] = rest * factor[j, j] if i > j else 1 / rest


@part
def solve(factor: Array, size: int, vector: Array) -> None:
    """Solve L D L^T x = vector (size,) in place. `factor` is from `factorise`."""
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
    for i in range(size - 1, -1, -1):
        vector[i] *= factor[i, i]
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]


@part
def dot(row: Array, vector: Array) -> float:
    """Scalar product, summed in order."""
    total = 0.0
    for j in range(len(row)):
        total += row[j] * vector[j]
    return total


@part
def copy(source: Array, into: Array) -> None:
    """Copy a vector. Compiling this loop takes 1 s less than compiling a slice assignment."""
    for k in range(len(source)):
        into[k] = source[k]


@part
def fill(into: Array, value: float) -> None:
    """Set all entries of a vector to a value."""
    for k in range(len(into)):
        into[k] = value


@part
def add(source: Array, into: Array) -> None:
    """Add a vector to another vector."""
    for k in range(len(source)):
        into[k] += source[k]


@part
def clear(rows: Array, width: int) -> None:
    """Set the columns in use to zero in all rows."""
    for i in range(len(rows)):
        for k in range(width):
            rows[i, k] = 0.0


@part
def copy_rows(source: Array, into: Array, width: int) -> None:
    """Copy the columns in use of all rows."""
    for i in range(len(source)):
        for k in range(width):
            into[i, k] = source[i, k]


@kernel
def add_product(scale: float, matrix: Array, rows: Array, into: Array, width: int) -> None:
    """Add scale times matrix (n, m) times rows (m, columns) to the rows `into` (n, columns)."""
    count, inner = matrix.shape
    for i in range(count):
        for j in range(inner):
            add_row(scale * matrix[i, j], rows[j], into[i], width)


@kernel
def solve_rows(factor: Array, size: int, rows: Array, width: int) -> None:
    """Solve L D L^T x = rows (size, columns) in place."""
    for i in range(size):
        for k in range(i):
            add_row(-factor[i, k], rows[k], rows[i], width)
    for i in range(size - 1, -1, -1):
        for column in range(width):
            rows[i, column] *= factor[i, i]
        for k in range(i + 1, size):
            add_row(-factor[k, i], rows[k], rows[i], width)
