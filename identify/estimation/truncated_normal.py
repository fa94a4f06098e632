"""Mean and covariance of a normal distribution that is truncated at linear bounds.

The truncated distribution is approximated by expectation propagation (Minka 2001; Cunningham et
al. 2011, "Gaussian probabilities and expectation propagation"). Each bound is replaced by a normal
factor. The factor is chosen such that mean and variance along the bound's direction agree with
those of the distribution that is truncated there. This is repeated for all bounds in turn until
nothing changes. For a single bound, mean and covariance are exact.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from identify.arrays import Array

FAR = 8.0
"""Distance of a bound, in standard deviations, from which it has no effect."""

DEEP = 100.0
"""Distance beyond a bound, in standard deviations, from which series replace the formulas."""

SWEEPS = 100
"""Largest number of passes over all bounds."""

SETTLED = 1e-9
"""Largest change of a factor, in standard deviations, at which the passes end."""


@dataclass(frozen=True)
class TruncatedNormal:
    """Normal distribution that is truncated at the bounds directions (k, p) @ x >= lower (k,).

    mean (p,), covariance (p, p): moments of the truncated distribution. precision, weighted (k,):
    precision of each bound's normal factor, and precision times its mean.
    """

    mean: Array
    covariance: Array
    directions: Array
    precision: Array
    weighted: Array

    def marginals(self, rows: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation (n,) of the quantities rows (n, p) @ x.

        They are those of a normal distribution that is not truncated at the quantity's own bound
        yet, if it has one.
        """
        mean = rows @ self.mean
        variance = np.einsum("gi,ij,gj->g", rows, self.covariance, rows)
        norms = np.linalg.norm(self.directions, axis=1)
        # the cosine of the angle between each quantity and each bound's direction
        along = rows @ self.directions.T
        parallel = along >= (1 - 1e-12) * np.linalg.norm(rows, axis=1)[:, None] * norms
        for n, k in np.argwhere(parallel & (along > 0) & (self.precision != 0)):
            scale = along[n, k] / norms[k] ** 2
            alone = 1.0 / variance[n] - self.precision[k] / scale**2
            mean[n] = (mean[n] / variance[n] - self.weighted[k] / scale) / alone
            variance[n] = 1.0 / alone
        return mean, np.sqrt(variance)


def truncated(mean: Array, covariance: Array, directions: Array, lower: Array) -> TruncatedNormal:
    """Return a normal distribution of mean (p,) and covariance (p, p) within bounds.

    directions (k, p), lower (k,): the bounds directions @ x >= lower. If the passes do not
    converge, the distribution is returned without bounds.
    """
    whole = TruncatedNormal(
        mean, covariance, directions, np.zeros(len(lower)), np.zeros(len(lower))
    )
    found = np.array(mean, dtype=float)
    spread = np.array(covariance, dtype=float)
    # natural parameters of the factors: precision, and precision times mean
    precision = np.zeros(len(lower))
    weighted = np.zeros(len(lower))
    for _ in range(SWEEPS):
        change = 0.0
        for k, (direction, least) in enumerate(zip(directions, lower, strict=True)):
            along = spread @ direction
            variance = float(direction @ along)
            if variance <= 0.0:
                continue  # the prior fixes this quantity
            centre = float(direction @ found)
            left = 1.0 / variance - precision[k]
            if left <= 0.0:
                return whole
            alone = (centre / variance - weighted[k]) / left
            new = _factor(alone, 1.0 / left, float(least))
            by_precision, by_weighted = new[0] - precision[k], new[1] - weighted[k]
            precision[k], weighted[k] = new
            gain = 1.0 / (1.0 + by_precision * variance)
            found += along * (gain * (by_weighted - by_precision * centre))
            spread -= np.outer(along, along) * (gain * by_precision)
            step = gain * (by_weighted - by_precision * centre) * variance**0.5
            change = max(change, abs(step), abs(by_precision) * variance)
        if change < SETTLED:
            return TruncatedNormal(found, spread, directions, precision, weighted)
    return whole


def _factor(mean: float, variance: float, lower: float) -> tuple[float, float]:
    """Return precision, and precision times mean, of the normal factor that replaces a bound."""
    std = variance**0.5
    beyond = (lower - mean) / std
    if beyond < -FAR:
        return 0.0, 0.0
    if beyond > DEEP:
        moved = beyond + 1.0 / beyond
        share = beyond**-2
    else:
        moved = float(np.exp(-0.5 * beyond**2 - log_ndtr(-beyond))) / np.sqrt(2.0 * np.pi)
        share = 1.0 - moved * (moved - beyond)
    truncated = variance * share
    precision = 1.0 / truncated - 1.0 / variance
    return precision, (mean + std * moved) / truncated - mean / variance
