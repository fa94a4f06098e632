"""Whiteness of residuals: does anything systematic remain in what the model does not explain?

A model driven by the logged commands feels everything the plant felt, so that with the right model its residuals are
the sensor's noise, independent from frame to frame. The portmanteau test of Ljung and Box asks whether their
autocorrelations could be chance: n (n + 2) sum_k r_k² / (n - k) over the lags k = 1 ... L is chi-square with L degrees
of freedom. (A model that closes its own loop cannot follow what the noise did to the plant: its residuals are coloured
even when it is right, and are not tested.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from identify.arrays import Array
from identify.errors import EstimationError
from identify.files.dataset import POSE

LAGS = 10
"""Lags tested, in frames."""

SUSPICIOUS = 1e-4
"""Probability of the residuals under the model below which the model is called wrong."""


@dataclass(frozen=True)
class Whiteness:
    """Result of the test: autocorrelations (6, lags) of the six pose components; p_values (6,) of each, and p_value of
    all together: the probability of correlations at least as large where nothing but noise remains."""

    autocorrelations: Array
    p_values: Array
    p_value: float

    @property
    def suspicious(self) -> bool:
        """Whether chance does not explain the correlations."""
        return self.p_value < SUSPICIOUS

    def warnings(self) -> tuple[str, ...]:
        """One line where chance does not explain the correlations."""
        if not self.suspicious:
            return ()
        parts = ", ".join(f"{name} {p:.1g}" for name, p in zip(POSE, self.p_values, strict=True))
        return (
            "the residuals of the model driven by the logged commands are not white (probability "
            f"{self.p_value:.1g}, by component {parts}): the model is wrong",
        )


def whiteness(residuals: Array, ok: NDArray[np.bool_], lags: int = LAGS) -> Whiteness:
    """Test residuals (N, 6) in standard deviations; frames with `ok` (N,) False are missing and may be NaN.

    Raises EstimationError with fewer than ten good frames a lag.
    """
    if ok.sum() < 10 * lags:
        raise EstimationError(f"{ok.sum()} good frames are too few to test {lags} lags, {10 * lags} are needed")
    centred = np.where(ok[:, None], residuals - residuals[ok].mean(axis=0), 0.0)
    power = np.sum(centred**2, axis=0)
    present = ok.astype(float)
    correlations, statistics = np.zeros((residuals.shape[1], lags)), np.zeros(residuals.shape[1])
    count = float(ok.sum())
    for lag in range(1, lags + 1):
        pairs = float(present[lag:] @ present[:-lag])
        correlations[:, lag - 1] = np.sum(centred[lag:] * centred[:-lag], axis=0) / power
        # Gaps leave fewer pairs than n - k; their number stands for it in the variance of r_k.
        statistics += (count + 2) * count * correlations[:, lag - 1] ** 2 / max(pairs, 1.0)
    together = float(chi2.sf(statistics.sum(), lags * len(statistics)))
    return Whiteness(correlations, np.asarray(chi2.sf(statistics, lags)), together)
