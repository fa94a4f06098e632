"""Whether a row of residuals speaks for a rig that moves: a sequential likelihood ratio.

That the rig is as it was calibrated and taught is one Gaussian model of all residuals: its errors are one draw of the
calibration's covariance, the same in every frame. Others let it walk at random, at one of several rates, or be more
wrong from the start than its covariance says. Each is a Kalman filter, and predicts the next residuals before it sees
them. The mean over the others of their likelihoods over that of the first one is, while the first is true, a martingale
with the mean one: it exceeds 1 / chance at any time of a run, however long, with at most that chance (Ville's
inequality), so no correction for looking often is needed.
Sources: J. Ville, Étude critique de la notion de collectif (1939); H. Robbins, Statistical methods related to the law
of the iterated logarithm, Ann. Math. Statist. 41 (1970).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from cmmsim.drift_watch.blocks import PLACES_OF_RIG, RIG, Rows
from cmmsim.geometry.pose import Array

SIZES = np.array([*2 * (*4 * (0.1,), 1e-4, 1e-4, 1e-5, 1e-5, 1e-4), *6 * (2e-5,), *len(PLACES_OF_RIG) * (2e-5,)])
"""Of a drift that matters, of each parameter, px, m and rad: a tenth of a pixel, 20 um, 20 urad."""

RATES = (0.05, 0.5, 5.0)
"""Standard deviations of random walks after WALK_FRAMES, in SIZES: a drift that comes in hours, minutes, seconds."""

WALK_FRAMES = 1000


class Filter:
    """Kalman filter of unknowns (n,) that walk at random: mean, covariance, and log likelihood of all that it saw."""

    def __init__(self, prior_std: Array, walk_std: Array) -> None:
        self.mean, self.covariance = np.zeros(len(prior_std)), np.diag(prior_std**2)
        self._walk, self.log_likelihood = np.diag(walk_std**2), 0.0

    def step(self, residuals: Array, columns: Array, frames: int) -> None:
        """See residuals (m,) of unit variance, with derivatives (m, n), so many frames after those before."""
        self.covariance += frames * self._walk
        gain = columns @ self.covariance
        lower = np.linalg.cholesky(gain @ columns.T + np.eye(len(residuals)))
        white = solve_triangular(lower, residuals - columns @ self.mean, lower=True)
        gain = solve_triangular(lower, gain, lower=True)
        self.log_likelihood -= 0.5 * float(white @ white) + float(np.log(np.diag(lower)).sum())
        self.mean = self.mean + gain.T @ white
        self.covariance = self.covariance - gain.T @ gain


@dataclass(frozen=True)
class Told:
    """What residuals say of a drift in SIZES, apart from what was expected of it: information (d, d), and score (d,),
    information times estimate. from_start: whether the rig was so at teaching already."""

    information: Array
    score: Array
    from_start: bool


class Evidence:
    """The filters of all models.

    Parameters: calibration (24, r): what of SIZES the calibration leaves of the rig's parameters for r independent
    numbers of unit variance; delay_std s; offset_std (o,) px of single centres; whether the rig's place shows.
    """

    def __init__(self, calibration: Array, delay_std: float, offset_std: Array, place_shows: bool) -> None:
        self._calibration, self._delay_std = calibration, delay_std
        self._size = len(SIZES) if place_shows else RIG
        known = np.concatenate([np.ones(calibration.shape[1]), np.ones(1), offset_std])
        still = np.zeros(len(known))
        self._fitting = Filter(known, still)
        self._walking = {
            rate: Filter(
                np.concatenate([np.zeros(self._size), known]),
                np.concatenate([np.full(self._size, rate / np.sqrt(WALK_FRAMES)), still]),
            )
            for rate in RATES
        }
        self._wrong = Filter(np.concatenate([np.ones(RIG), known]), np.zeros(RIG + len(known)))
        self._frames = 0

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood of a rig that has moved, mean over the models of it, over that of one that has
        not."""
        others = np.array([one.log_likelihood for one in (*self._walking.values(), self._wrong)])
        return float(np.logaddexp.reduce(others) - np.log(len(others)) - self._fitting.log_likelihood)

    def step(self, rows: Rows, frames: int) -> None:
        """See rows, so many frames after those before."""
        self._frames += frames
        by_start = rows.by_start * SIZES[:RIG]
        known = np.hstack([by_start @ self._calibration, self._delay_std * rows.by_delay, rows.by_offsets])
        by_drift = (rows.by_drift * SIZES)[:, : self._size]
        self._fitting.step(rows.residuals, known, frames)
        for one in self._walking.values():
            one.step(rows.residuals, np.hstack([by_drift, known]), frames)
        self._wrong.step(rows.residuals, np.hstack([by_start, known]), frames)

    @property
    def sensitivity(self) -> Array:
        """Information (d, d) about a drift in SIZES, of the slowest that is watched for."""
        slow = min(RATES)
        return _without_prior(self._walking[slow], self._size, self._walked(slow))[0]

    @property
    def told(self) -> Told:
        """What the likeliest of the models with a movement says of it."""
        rate, walking = max(self._walking.items(), key=lambda item: item[1].log_likelihood)
        from_start = self._wrong.log_likelihood > walking.log_likelihood
        if from_start:
            return Told(*_without_prior(self._wrong, RIG, 1.0), from_start)
        return Told(*_without_prior(walking, self._size, self._walked(rate)), from_start)

    def _walked(self, rate: float) -> float:
        """Variance of a walk after all frames."""
        return rate**2 * max(self._frames, 1) / WALK_FRAMES


def _without_prior(filtered: Filter, size: int, prior_variance: float) -> tuple[Array, Array]:
    """Information (d, d) and score (d,) that residuals gave about the first d unknowns, from what they are after it."""
    if not filtered.covariance[:size, :size].any():  # nothing has been seen, and nothing has walked
        return np.zeros((size, size)), np.zeros(size)
    precise = np.linalg.inv(filtered.covariance[:size, :size])
    return precise - np.eye(size) / prior_variance, precise @ filtered.mean[:size]
