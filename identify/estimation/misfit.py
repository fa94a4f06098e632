"""How far a model misses its record beyond what the sensor's noise explains, and what that does to the intervals.

With the right model the mean squared whitened residual is what noise makes of it, but for chance. Where it is larger
than chance allows, the rest is an error of the model. Unlike noise such an error lasts from frame to frame, and moves
an estimate further than white residuals of the same size would: scaling the covariance by the residual (Birge's ratio)
is not enough. The scores J^T r of stationary residuals with the autocorrelation R_k have the covariance

    sum over frames i, j of J_i^T R_(i-j) J_j

(Morelli and Klein, "Accuracy of aerodynamic model parameters estimated from flight test data", J. Guidance, Control,
and Dynamics 20(1), 1997), with R_k from the residuals themselves. The model's share is added to what the noise makes.

No residual shows the part of an error that the parameters take up. Where the model's error makes most of the residual,
no interval can be trusted, and nothing counts as identified.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import norm

from identify.arrays import Array

SIGNIFICANT = float(norm.ppf(0.999))
"""Standard deviations above the expected residual beyond which the rest is called an error of the model."""

MISFIT_STDS = 5.0
"""Standard deviations that a record may be away from the expected residual: below, the stated covariance is wrong."""

NOISE_DECIDES = 3.0
"""Residual, in units of the expected one, beyond which the model's error decides, not the noise."""

REACH = 0.2
"""Of a record's length: the lags after which residuals are taken as independent; up to there correlations fade out."""


@dataclass(frozen=True)
class Misfit:
    """Mean squared whitened residual that was found, what noise alone would make of it, and how far that spreads from
    one experiment to the next."""

    found: float
    expected: float
    std: float

    @property
    def significant(self) -> bool:
        """Whether the model misses the record by more than chance explains."""
        return self.found > self.expected + SIGNIFICANT * self.std

    @property
    def share_of_model(self) -> float:
        """The part of the residual's variance that is the model's error; zero where it may be chance."""
        return 1 - self.expected / self.found if self.significant else 0.0

    @property
    def decides(self) -> bool:
        """Whether the model's error makes most of the residual."""
        return self.found > NOISE_DECIDES * self.expected

    def warnings(self, model: str = "the model") -> tuple[str, ...]:
        """One line where noise does not explain the residual: a local minimum, or a model or covariance is wrong."""
        says = (
            f"{model} misses the record by {self.found:.3f} times the noise variance, noise alone gives "
            f"{self.expected:.3f} ± {self.std:.3f}: "
        )
        if self.decides:
            says += "the model or the stated covariance is wrong, its error decides, and nothing counts as identified"
        elif self.significant:
            says += (
                "the model or the stated covariance is wrong; the intervals are widened by what the residuals show, "
                "and cannot know what the parameters took up"
            )
        elif self.found < self.expected - MISFIT_STDS * self.std:
            says += "the stated covariance is wrong, and the intervals are too wide"
        else:
            return ()
        return (says,)


def misfit_of_white(residuals: Array) -> Misfit:
    """Misfit of whitened residuals (n, 6) that noise alone would leave white, as those of a model that is driven by the
    logged commands."""
    return Misfit(float(np.mean(residuals**2)), 1.0, float(np.sqrt(2 / residuals.size)))


def coloured_score_covariance(residuals: Array, jacobian: Array, ok: NDArray[np.bool_]) -> Array:
    """Covariance (p, p) of J^T r for residuals r as correlated as those found, (n, 6), with their Jacobian (n, 6, p).

    Both are of the good frames, `ok` (N,); those between them have no residual, and add nothing.
    """
    count, size = len(ok), jacobian.shape[2]
    rows, slopes = np.zeros((count, 6)), np.zeros((count, 6, size))
    rows[ok], slopes[ok] = residuals, jacobian
    length = next_fast_len(2 * count, real=True)
    spectrum = rfft(rows, length, axis=0)
    correlations = irfft(spectrum[:, :, None] * spectrum[:, None, :].conj(), length, axis=0) / ok.sum()
    lags = np.minimum(np.arange(length), length - np.arange(length))
    fading = np.maximum(1 - lags / (REACH * count), 0.0)  # keeps the sum positive semidefinite
    density = rfft(correlations * fading[:, None, None], axis=0)
    seen = rfft(slopes, length, axis=0)
    weighted = np.einsum("fij,fjb->fib", density, seen)
    weighted[1 : (length + 1) // 2] *= 2  # the negative frequencies; zero and Nyquist have none
    total = np.tensordot(seen.conj(), weighted, axes=([0, 1], [0, 1])).real / length
    return np.asarray((total + total.T) / 2, dtype=float)
