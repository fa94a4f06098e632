"""How the mean square of a positive figure depends on other quantities: regression of its logarithm.

The mean square of a row's figure is taken as exp(X beta). The estimate solves X^T (y^2 / mean - 1) = 0, the score of a
gamma-distributed y^2 with logarithmic link (McCullagh and Nelder 1989, section 8.3); unlike a straight line through
logarithms it says how the mean square itself scales, whatever the figure's distribution is and however it changes from
row to row. Its covariance is the sandwich of that score, so rows need not be alike either.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from identify.arrays import Array
from identify.errors import StudyError

ITERATIONS = 100
SETTLED = 1e-10
SMALLEST = 1e-12
"""Share of the largest square below which a square counts as that share at the start of the fit."""


@dataclass(frozen=True)
class ScaleRegression:
    """Coefficients (k,) of the logarithm of the mean square, their covariance (k, k), and the degrees of freedom."""

    coefficients: Array
    covariance: Array
    freedom: int

    def interval(self, index: int, confidence: float) -> tuple[float, float]:
        """Student's interval of one coefficient."""
        half = student.ppf(0.5 + 0.5 * confidence, self.freedom) * np.sqrt(self.covariance[index, index])
        return float(self.coefficients[index] - half), float(self.coefficients[index] + half)


def scale_regression(squares: Array, design: Array) -> ScaleRegression:
    """Fit squares (n,), not negative, to exp(design (n, k) @ beta).

    Raises StudyError with too few rows, a design that does not tell its columns apart, or figures that are all zero.
    """
    rows, columns = design.shape
    if rows <= columns:
        raise StudyError(f"{rows} rows do not determine {columns} coefficients with an interval")
    if np.linalg.matrix_rank(design) < columns:
        raise StudyError("the factors do not vary, or not independently of each other")
    if not squares.max() > 0.0:
        raise StudyError("the figure is zero in every row")
    beta = np.linalg.lstsq(design, np.log(np.maximum(squares, SMALLEST * squares.max())), rcond=None)[0]
    for _ in range(ITERATIONS):
        ratio = squares / np.exp(design @ beta)
        step = np.linalg.lstsq(design, ratio - 1.0, rcond=None)[0]
        change = float(np.abs(design @ step).max())
        if change < SETTLED:
            break
        beta = beta + step / max(1.0, change)
    else:
        raise StudyError(f"the fit of the scale has not settled after {ITERATIONS} steps")
    return ScaleRegression(beta, _sandwich(design, squares / np.exp(design @ beta) - 1.0), rows - columns)


def _sandwich(design: Array, residuals: Array) -> Array:
    """Covariance of the coefficients, with residuals enlarged by their leverage (HC3) against few rows."""
    bread = np.linalg.inv(design.T @ design)
    leverage = np.einsum("ni,ij,nj->n", design, bread, design)
    scores = design * (residuals / np.maximum(1.0 - leverage, 1e-6))[:, None]
    return np.asarray(bread @ (scores.T @ scores) @ bread, dtype=float)
