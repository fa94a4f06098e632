"""Mean, spread and rms of a figure over the rows of one point of a study, with bands that hold 95 % of the time.

The band of the mean is Student's; that of the rms is Student's of the logarithm of the mean square. A chi-square band
would need to know how many independent errors a row's figure is made of; this one takes their scatter from the rows.
Counted, it holds the rms of three normal numbers or more in 95 to 97 % of cases from two rows on, and that of single
normal numbers, the worst case, in 92 % at least. One row alone has no band.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from identify.arrays import Array

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Statistics:
    """Of `rows` rows: mean, std (n - 1), rms, and the bands of mean and rms; None with a single row."""

    rows: int
    mean: float
    std: float | None
    rms: float
    mean_band: tuple[float, float] | None
    rms_band: tuple[float, float] | None


def point_statistics(values: Array) -> Statistics:
    """Statistics of one figure's values (n,), n >= 1, all finite."""
    count, mean, rms = len(values), float(np.mean(values)), float(np.sqrt(np.mean(values**2)))
    if count < 2:
        return Statistics(count, mean, None, rms, None, None)
    std = float(np.std(values, ddof=1))
    half = float(student.ppf(0.5 + 0.5 * CONFIDENCE, count - 1)) * std / np.sqrt(count)
    return Statistics(count, mean, std, rms, (mean - half, mean + half), _rms_band(values))


def _rms_band(values: Array) -> tuple[float, float]:
    if not np.any(values):
        return 0.0, 0.0
    count, square = len(values), float(np.mean(values**2))
    spread = float(np.linalg.norm(values**2 / square - 1.0)) / (count - 1)
    factor = float(np.exp(0.5 * student.ppf(0.5 + 0.5 * CONFIDENCE, count - 1) * spread))
    return float(np.sqrt(square)) / factor, float(np.sqrt(square)) * factor
