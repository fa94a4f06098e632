"""Noise, jumps and spectrum of measured poses, from the poses alone.

A motion is smooth over a few frames, and the noise of the sensor is not. In a window of poses, a
polynomial in their times follows the motion. What it leaves at the middle of the window is noise,
apart from the known share that the polynomial follows, too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from identify.arrays import Array
from identify.filtering import interpolated

WINDOW = 9
"""Number of poses in a window."""

DEGREE = 5
"""Degree of the polynomial, which follows motions of up to a fifth of the frame rate."""

GAP = 1.5
"""Largest time between two poses of a window, in median intervals."""

NORMAL = 1.4826
"""Ratio of the standard deviation of normal numbers to their median magnitude."""

JUMPS = 8.0
"""Smallest deviation of a pose that counts as a jump, in standard deviations."""

MOVING = 0.99
"""Share of the power of a motion that lies below its highest frequency."""

MOVES = 2.0
"""Smallest standard deviation of what moves, in that of its noise."""

SEGMENTS = 4
"""Number of segments of the spectrum, and more as they overlap."""

SHORTEST = 128
"""Smallest number of frames of a segment, if there are as many."""


@dataclass(frozen=True)
class PoseNoise:
    """Noise of measured poses.

    Attributes
    ----------
    std : ndarray, shape (6,)
        Standard deviation of each entry of a pose, m and rad. NaN if no window is whole.
    time : ndarray, shape (K,)
        Times of the middles of the windows, s.
    deviation : ndarray, shape (K, 6)
        Deviation of the pose from its neighbours, m and rad.
    jumped : ndarray, shape (K,)
        True where the deviation is more than `JUMPS` standard deviations, and no neighbour deviates
        more.
    """

    std: Array
    time: Array
    deviation: Array
    jumped: NDArray[np.bool_]


@dataclass(frozen=True)
class Windows:
    """Windows of rows (N,) at these times that are near enough to each other.

    Attributes
    ----------
    middles : ndarray, shape (K,)
        Rows in the middles of the windows.
    rows : ndarray, shape (K, w)
        Rows of the windows.
    basis : ndarray, shape (K, w, p)
        Orthonormal polynomials of the times.
    """

    middles: NDArray[np.intp]
    rows: NDArray[np.intp]
    basis: Array

    @property
    def left(self) -> Array:
        """Share (K,) of the variance of noise in the middle that the polynomials leave."""
        return np.asarray(1 - (self.basis[:, WINDOW // 2] ** 2).sum(axis=1))

    def residuals(self, values: Array) -> Array:
        """Return what the polynomials leave of values (N, n) in the middles, (K, n)."""
        middle = self.basis[:, WINDOW // 2]
        inside = values[self.rows]
        fitted = np.einsum("kp,kwp,kwc->kc", middle, self.basis, inside, optimize=True)
        return np.asarray(values[self.middles] - fitted)


def windows_of(time: Array) -> Windows:
    """Return the windows of rows at times (N,), s."""
    reach = np.arange(WINDOW) - WINDOW // 2
    middles = np.arange(WINDOW // 2, max(len(time) - WINDOW // 2, WINDOW // 2))
    rows = middles[:, None] + reach
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    whole = (np.diff(time[rows], axis=1) <= GAP * step).all(axis=1)
    middles, rows = middles[whole], rows[whole]
    # Times in half windows make all powers of similar size.
    since = (time[rows] - time[middles][:, None]) / (step * (WINDOW // 2))
    basis = np.linalg.qr(since[..., None] ** np.arange(DEGREE + 1))[0]
    return Windows(middles, rows, basis)


def pose_noise(time: Array, poses: Array) -> PoseNoise:
    """Return the noise of poses (N, 6) that were measured at times (N,)."""
    windows = windows_of(time)
    if not len(windows.middles):
        return PoseNoise(np.full(6, np.nan), np.zeros(0), np.zeros((0, 6)), np.zeros(0, dtype=bool))
    left = windows.left
    residual = windows.residuals(poses)
    std = NORMAL * np.median(np.abs(residual) / np.sqrt(left)[:, None], axis=0)
    # Without the pose itself, the polynomial of its neighbours would miss it by this.
    deviation = residual / left[:, None]
    spread = std / np.sqrt(left)[:, None]
    excess = (np.abs(deviation) / np.where(spread > 0, spread, np.inf)).max(axis=1)
    jumped = (excess > JUMPS) & (excess >= _largest_near(excess, windows.middles))
    return PoseNoise(std, time[windows.middles], deviation, jumped)


def _largest_near(excess: Array, middles: NDArray[np.intp]) -> Array:
    """Return the largest excess (K,) within half a window of each pose."""
    whole = np.zeros(middles[-1] + WINDOW)
    whole[middles] = excess
    near = np.arange(WINDOW) - WINDOW // 2
    return np.asarray(whole[middles[:, None] + near].max(axis=1))


@dataclass(frozen=True)
class Spectrum:
    """Power of a motion by frequency.

    Attributes
    ----------
    frequency : ndarray, shape (F,)
        Frequencies, Hz.
    power : ndarray, shape (F, 6)
        Power of each entry of a pose, m2/Hz and rad2/Hz.
    highest_hz : float
        Frequency below which 99 % of the power of the positions and of the angles lies, zero if
        nothing moves.
    """

    frequency: Array
    power: Array
    highest_hz: float


def mean_rate(time: Array) -> float:
    """Return the rate of rows at times (N,), Hz, without their gaps.

    Times that are rounded, as to milliseconds, have another median interval than the rate.
    """
    steps = np.diff(time)
    return 1 / float(steps[steps <= GAP * np.median(steps)].mean())


def spectrum(time: Array, poses: Array, noise: Array) -> Spectrum:
    """Return the spectrum of poses (N, 6) that were measured at times (N,).

    Poses are interpolated at even times, which are as many. Positions or angles that move no more
    than their noise (6,), m and rad, have no highest frequency.
    """
    even = np.linspace(time[0], time[-1], len(time))
    rate = (len(time) - 1) / (time[-1] - time[0])
    values = interpolated(even, time, poses)
    length = min(max(len(time) // SEGMENTS, SHORTEST), len(time))
    frequency, power = welch(values, rate, nperseg=length, detrend="linear", axis=0)
    highest = 0.0
    for kind in (slice(0, 3), slice(3, 6)):
        total = np.cumsum(power[:, kind].sum(axis=1))
        if (values[:, kind].std(axis=0) > MOVES * noise[kind]).any():
            place = int(np.searchsorted(total, MOVING * total[-1]))
            highest = max(highest, float(frequency[place]))
    return Spectrum(frequency, power, highest)
