"""Logarithm of the determinant of a symmetric positive definite matrix as a CasADi function."""

from functools import lru_cache

import casadi as ca


@lru_cache(maxsize=4)
def log_determinant(size: int) -> ca.Function:
    """Matrix (size, size), of which the upper triangle is read -> ln det, by LDL^T; NaN where it is not positive."""
    matrix = ca.SX.sym("matrix", size, size)
    upper = ca.triu(matrix)
    diagonal, _, _ = ca.ldl(upper + ca.triu(matrix, False).T, False)
    return ca.Function("log_determinant", [matrix], [ca.sum1(ca.log(diagonal))])
