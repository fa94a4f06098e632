"""Mean and covariance of a normal distribution that is truncated at linear bounds.

The truncated distribution is approximated by expectation propagation (Minka 2001; Cunningham et
al. 2011, "Gaussian probabilities and expectation propagation"). Each bound is replaced by a normal
factor. The factor is chosen such that mean and variance along the bound's direction agree with
those of the distribution that is truncated there. All bounds are visited in turn until their
factors no longer change. For a single bound, mean and covariance are exact.

The normal distribution may have been computed with noise that is smaller than the true noise. Its
mean then errs by more than its covariance says. The factors of the bounds are further knowledge,
which reduces this excess as it reduces the covariance.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from identify.arrays import Array

FAR = 8.0
"""Distance of the mean inside a bound, in standard deviations, above which the bound is ignored."""

DEEP = 100.0
"""Distance of the mean beyond a bound, in standard deviations, above which a series is used.

Farther beyond, the exact formulas would lose all digits.
"""

SWEEPS = 100
"""Largest number of passes over all bounds."""

SETTLED = 1e-9
"""Change of the mean, in standard deviations, and relative change of a precision, below which the
passes end.
"""


@dataclass(frozen=True)
class TruncatedNormal:
    """Normal distribution that is truncated at the bounds directions (k, p) @ x >= lower (k,).

    mean (p,), covariance (p, p): moments of the truncated distribution. precision, weighted (k,):
    precision of each bound's normal factor, and precision times mean of this factor. Both are zero
    for a bound without effect. excess (p, p): covariance of the mean, as it would be without
    bounds, minus the covariance of the distribution that is truncated.
    """

    mean: Array
    covariance: Array
    directions: Array
    precision: Array
    weighted: Array
    excess: Array

    def marginals(self, rows: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation (n,) of the quantities rows (n, p) @ x.

        The excess is included. If a quantity is a positive multiple of a bounded one, the factor of
        this bound is taken out again. Truncated at the bound, the returned normal distribution is
        then the quantity's.
        """
        mean = rows @ self.mean
        reduced = rows @ self.covariance
        variance = np.einsum("gi,gi->g", reduced, rows)
        # Derivatives of the means with respect to the mean without bounds.
        gains = rows - (reduced @ self.directions.T * self.precision) @ self.directions
        excess = np.einsum("gi,ij,gj->g", gains, self.excess, gains)
        norms = np.linalg.norm(self.directions, axis=1)
        # Scalar products of each quantity with each bound's direction.
        products = rows @ self.directions.T
        parallel = products >= (1 - 1e-12) * np.linalg.norm(rows, axis=1)[:, None] * norms
        for n, k in np.argwhere(parallel & (products > 0) & (self.precision != 0)):
            scale = products[n, k] / norms[k] ** 2
            remaining = 1.0 / variance[n] - self.precision[k] / scale**2
            mean[n] = (mean[n] / variance[n] - self.weighted[k] / scale) / remaining
            excess[n] /= (variance[n] * remaining) ** 2
            variance[n] = 1.0 / remaining
        return mean, np.sqrt(variance + excess)


def truncated(
    mean: Array,
    covariance: Array,
    directions: Array,
    lower: Array,
    excess: Array | float = 0.0,
) -> TruncatedNormal:
    """Return the normal distribution with mean (p,) and covariance (p, p), truncated at bounds.

    directions (k, p), lower (k,): the bounds directions @ x >= lower. excess (p, p): further
    covariance of the mean, see `TruncatedNormal`. If the passes do not
    converge, or if the distribution without one bound's factor has no positive variance, the
    distribution is returned without bounds.
    """
    beyond = np.broadcast_to(excess, covariance.shape)
    zeros = np.zeros(len(lower))
    untruncated = TruncatedNormal(mean, covariance, directions, zeros, zeros, beyond)
    new_mean = np.array(mean, dtype=float)
    new_covariance = np.array(covariance, dtype=float)
    # Natural parameters of the factors: precision, and precision times mean.
    precision = np.zeros(len(lower))
    weighted = np.zeros(len(lower))
    for _ in range(SWEEPS):
        change = 0.0
        for k, (direction, bound) in enumerate(zip(directions, lower, strict=True)):
            # Covariance of x with the bounded quantity.
            cross = new_covariance @ direction
            variance = float(direction @ cross)
            if variance <= 0.0:
                continue  # the covariance leaves this quantity no freedom
            centre = float(direction @ new_mean)
            # The cavity is the distribution without the factor of this bound.
            cavity_precision = 1.0 / variance - precision[k]
            if cavity_precision <= 0.0:
                return untruncated
            cavity_mean = (centre / variance - weighted[k]) / cavity_precision
            factor = _factor(cavity_mean, 1.0 / cavity_precision, float(bound))
            by_precision = factor[0] - precision[k]
            by_weighted = factor[1] - weighted[k]
            precision[k], weighted[k] = factor
            gain = 1.0 / (1.0 + by_precision * variance)
            new_mean += cross * (gain * (by_weighted - by_precision * centre))
            new_covariance -= np.outer(cross, cross) * (gain * by_precision)
            step = gain * (by_weighted - by_precision * centre) * variance**0.5
            change = max(change, abs(step), abs(by_precision) * variance)
        if change < SETTLED:
            return TruncatedNormal(
                new_mean, new_covariance, directions, precision, weighted, beyond
            )
    return untruncated


def _factor(mean: float, variance: float, lower: float) -> tuple[float, float]:
    """Return precision, and precision times mean, of the normal factor that replaces a bound.

    mean, variance: moments of the bounded quantity without this factor.
    """
    std = variance**0.5
    beyond = (lower - mean) / std
    if beyond < -FAR:
        return 0.0, 0.0
    if beyond > DEEP:
        shift = beyond + 1.0 / beyond
        ratio = beyond**-2
    else:
        shift = float(np.exp(-0.5 * beyond**2 - log_ndtr(-beyond))) / np.sqrt(2.0 * np.pi)
        ratio = 1.0 - shift * (shift - beyond)
    # Mean and variance of the truncated quantity are mean + std * shift and variance * ratio.
    truncated_variance = variance * ratio
    precision = 1.0 / truncated_variance - 1.0 / variance
    return precision, (mean + std * shift) / truncated_variance - mean / variance
