"""Noise and spectrum of measured poses, from the poses alone.

A motion is smooth over a few frames, and the noise of the sensor is not. The noise is therefore
found from the deviations of poses from polynomials through their neighbours (`smoothness`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from identify.arrays import Array
from identify.filtering import interpolated
from identify.record.smoothness import windows_of

NORMAL = 1.4826
"""Ratio of the standard deviation of normal numbers to their median magnitude."""

MOVING = 0.99
"""Share of the power of a motion that lies below its highest frequency."""

MOVES = 2.0
"""Smallest standard deviation of a moving component, as a multiple of that of its noise."""

SEGMENTS = 4
"""Number of segments of the spectrum, not counting those that overlap two others."""

SHORTEST = 128
"""Smallest number of frames of a segment, if the record has that many."""


def pose_noise(time: Array, poses: Array) -> Array:
    """Return the standard deviation (6,) of the noise of poses (N, 6) at times (N,), m and rad.

    It is NaN if no poses are near enough to each other in time.
    """
    windows = windows_of(time)
    if not len(windows.rows):
        return np.full(6, np.nan)
    deviation = windows.deviations(poses) / np.sqrt(windows.variance)[:, None]
    return np.asarray(NORMAL * np.median(np.abs(deviation), axis=0))


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


def spectrum(time: Array, poses: Array, noise: Array) -> Spectrum:
    """Return the spectrum of poses (N, 6) that were measured at times (N,).

    Poses are interpolated at N evenly spaced times. Positions or angles that move no more than
    their noise (6,), m and rad, have no highest frequency.
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
