"""Sequential likelihood ratio for a rig that moves, from a row of residuals.

That the rig is as it was calibrated and taught is one Gaussian model of all residuals: its errors
are one draw of the calibration's covariance, the same in every frame. Others let it walk at random,
at one of several rates, or be more wrong from the start than its covariance says. Each is a Kalman
filter, and predicts the next residuals before it sees them. The mean over the others of their
likelihoods over that of the first one is, while the first is true, a martingale with the mean one:
it exceeds 1 / chance at any time of a run, however long, with at most that chance (Ville's
inequality), so no correction for looking often is needed. Sources: J. Ville, Étude critique de la
notion de collectif (1939); H. Robbins, Statistical methods related to the law of the iterated
logarithm, Ann. Math. Statist. 41 (1970).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from cmmsim.geometry.pose import Array
from cmmsim.uncertainty.drift_blocks import PLACES_OF_RIG, RIG, Rows

SIZES = np.array(
    [*2 * (*4 * (0.1,), 1e-4, 1e-4, 1e-5, 1e-5, 1e-4), *6 * (2e-5,), *len(PLACES_OF_RIG) * (2e-5,)]
)
"""Of a drift that matters, of each parameter, px, m and rad: a tenth of a pixel, 20 um, 20 urad."""

RATES = (0.05, 0.5, 5.0)
"""Standard deviations of random walks after WALK_FRAMES, in SIZES: a drift that comes in hours,
minutes, seconds.
"""

WALK_FRAMES = 1000


class Filter:
    """Kalman filter of unknowns (n,), of which the first w walk at random and are zero before the
    first step: in its information form, since one product of the derivatives serves all models, and
    few unknowns walk.

    What was seen makes the density of the unknowns x proportional to exp(constant + right x - x
    precision x / 2). Source: B. D. O. Anderson and J. B. Moore, Optimal Filtering (1979), section
    6.3.
    """

    def __init__(self, prior_std: Array, walk_std: Array) -> None:
        self._walk = walk_std**2
        self.precision = np.diag(np.concatenate([np.zeros(len(walk_std)), prior_std**-2]))
        self.right = np.zeros(len(self.precision))
        self._constant = -float(np.log(prior_std).sum())

    def step(self, gram: Array, right: Array, squared: float, frames: int) -> None:
        """See residuals r of unit variance with derivatives D (m, n), so many frames after those
        before: D'D (n, n), D'r (n,) and r'r."""
        if len(self._walk):
            self._walk_on(frames)
        self.precision += gram
        self.right += right
        self._constant -= 0.5 * squared

    def _walk_on(self, frames: int) -> None:
        w = len(self._walk)
        walked = frames * self._walk
        if not self.precision[0, 0]:
            self.precision[range(w), range(w)] = 1.0 / walked
            self._constant -= 0.5 * float(np.log(walked).sum())
            return
        both = np.column_stack([self.precision[:w], self.right[:w]])
        lower, part = _factored(self.precision[:w, :w] + np.diag(1.0 / walked), both)
        self.precision -= part[:, :-1].T @ part[:, :-1]
        self.right -= part[:, :-1].T @ part[:, -1]
        logarithms = float(np.log(np.diag(lower)).sum() + 0.5 * np.log(walked).sum())
        self._constant += 0.5 * float(part[:, -1] @ part[:, -1]) - logarithms

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all residuals so far."""
        if not self.precision[0, 0]:  # nothing was seen
            return 0.0
        lower, part = _factored(self.precision, self.right)
        return self._constant + 0.5 * float(part @ part) - float(np.log(np.diag(lower)).sum())

    def told_of(self, first: int) -> tuple[Array, Array]:
        """Information (d, d) about the first d unknowns, and score (d,), whatever the others
        are."""
        others = np.linalg.solve(self.precision[first:, first:], self.precision[first:, :first])
        return (
            self.precision[:first, :first] - self.precision[:first, first:] @ others,
            self.right[:first] - others.T @ self.right[first:],
        )


def _factored(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Lower Cholesky factor L of a matrix (n, n), its upper part left as it was, and L^-1 right
    (n,) or (n, p); plain LAPACK, whose callers in SciPy take longer than the work."""
    lower, failed = dpotrf(matrix, lower=True, clean=False)
    if failed:
        raise np.linalg.LinAlgError(f"no positive definite matrix: minor {failed} of {len(matrix)}")
    return lower, dtrtrs(lower, right, lower=True)[0]


@dataclass(frozen=True)
class Told:
    """Information on a drift in SIZES from residuals, apart from what was expected of it.

    ``information`` (d, d), and ``score`` (d,), which is information times estimate. ``from_start``:
    whether the rig was so at teaching already.
    """

    information: Array
    score: Array
    from_start: bool


class Evidence:
    """The filters of all models.

    Parameters: calibration (24, r): what of SIZES the calibration leaves of the rig's parameters
    for r independent numbers of unit variance; delay_std s; offset_std (o,) px of single centres;
    whether the rig's place shows.
    """

    def __init__(
        self, calibration: Array, delay_std: float, offset_std: Array, place_shows: bool
    ) -> None:
        self._calibration = calibration
        self._delay_std = delay_std
        self._size = len(SIZES) if place_shows else RIG
        known = np.concatenate([np.ones(calibration.shape[1]), np.ones(1), offset_std])
        self._fitting = Filter(known, np.zeros(0))
        self._walking = {
            rate: Filter(known, np.full(self._size, rate / np.sqrt(WALK_FRAMES))) for rate in RATES
        }
        self._wrong = Filter(np.concatenate([np.ones(RIG), known]), np.zeros(0))
        self._frames = 0

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood of a rig that has moved, mean over the models of it, over
        that of one that has not."""
        others = np.array([one.log_likelihood for one in (*self._walking.values(), self._wrong)])
        return float(
            np.logaddexp.reduce(others) - np.log(len(others)) - self._fitting.log_likelihood
        )

    def products(self, rows: Rows) -> Array:
        """Products (b, n, n) of the residuals and derivatives of b blocks with each other, as
        ``step`` takes them.
        """
        by_start = rows.by_start * SIZES[:RIG]
        known = [by_start @ self._calibration, self._delay_std * rows.by_delay, rows.by_offsets]
        by_drift = (rows.by_drift * SIZES)[..., : self._size]
        every = np.concatenate([by_drift, by_start, *known, rows.residuals[..., None]], axis=-1)
        return np.asarray(every.swapaxes(1, 2) @ every)

    def step(self, products: Array, frames: int) -> None:
        """See a block by its products (n, n), so many frames after those before."""
        self._frames += frames
        size = self._size
        drifted = np.delete(np.arange(len(products) - 1), slice(self._size, self._size + RIG))

        def see(one: Filter, columns: slice | NDArray[np.int_]) -> None:
            one.step(
                products[columns][:, columns],
                products[columns, -1],
                float(products[-1, -1]),
                frames,
            )

        see(self._fitting, slice(size + RIG, -1))
        see(self._wrong, slice(size, -1))
        for one in self._walking.values():
            see(one, drifted)

    @property
    def sensitivity(self) -> Array:
        """Information (d, d) about a drift in SIZES, of the slowest that is watched for."""
        slow = min(RATES)
        return _without_prior(self._walking[slow], self._size, self._walked(slow))[0]

    @property
    def told(self) -> Told:
        """Statement of the likeliest of the models with a movement."""
        rate, walking = max(self._walking.items(), key=lambda item: item[1].log_likelihood)
        from_start = self._wrong.log_likelihood > walking.log_likelihood
        if from_start:
            return Told(*_without_prior(self._wrong, RIG, 1.0), from_start)
        return Told(*_without_prior(walking, self._size, self._walked(rate)), from_start)

    def _walked(self, rate: float) -> float:
        """Variance of a walk after all frames."""
        return rate**2 * max(self._frames, 1) / WALK_FRAMES


def _without_prior(filtered: Filter, size: int, prior_variance: float) -> tuple[Array, Array]:
    """Information (d, d) and score (d,) that residuals gave about the first d unknowns, beyond that
    of a prior.
    """
    information, score = filtered.told_of(size)
    if not information.any():  # nothing has been seen, and nothing has walked
        return information, score
    return information - np.eye(size) / prior_variance, score
