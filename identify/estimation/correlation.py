"""Correlation of estimates: which of them a record ties together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identify.arrays import Array


@dataclass(frozen=True)
class Pair:
    """Two quantities and the correlation of their estimates."""

    first: str
    second: str
    correlation: float


def correlation_matrix(covariance: Array) -> Array:
    """Correlations (n, n) of a covariance (n, n) with positive variances."""
    std = np.sqrt(np.diag(covariance))
    correlations = np.asarray(covariance / np.outer(std, std), dtype=float)
    np.fill_diagonal(correlations, 1.0)
    return correlations


def strongest_pairs(correlations: Array, names: Sequence[str], count: int) -> list[Pair]:
    """The `count` pairs with the largest correlations (n, n) in size, the largest first."""
    rows, columns = np.triu_indices(len(names), 1)
    order = np.argsort(-np.abs(correlations[rows, columns]), kind="stable")[:count]
    return [Pair(names[rows[k]], names[columns[k]], float(correlations[rows[k], columns[k]])) for k in order]
