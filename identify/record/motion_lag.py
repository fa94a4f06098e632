"""Lag of a robot's motion behind its commands, by their correlation.

The lag is that of the drives, the latency, and the difference of the clocks with which poses and
commands are logged. Only their sum can be seen here.
"""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.filtering import interpolated

FINEST_S = 1e-3
"""Smallest step, s, of the lags that are tried. The best is then refined by a parabola."""

CLOSE_S = 1.0
"""Largest lag, s, that is tried first. Larger lags can be wrong by a period of the motion."""

ALIKE = 0.02
"""Difference of correlations below which the smaller lag is taken."""

FEWEST = 8
"""Smallest number of poses that overlap with commands."""


@dataclass(frozen=True)
class MotionLag:
    """Lag, s, positive where the motion is later, and the correlation (-1 to 1) at this lag."""

    seconds: float
    correlation: float


def motion_lag(time: Array, coordinates: Array, command_time: Array, command: Array) -> MotionLag:
    """Return the lag at which joint coordinates follow commands best.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Times of the coordinates, s.
    coordinates : ndarray, shape (N, n)
        Joint coordinates at measured poses.
    command_time : ndarray, shape (M,)
        Times of the commands, s.
    command : ndarray, shape (M, n)
        Joint commands.

    Returns
    -------
    MotionLag
        The lag, of at most half the duration. The correlation is zero if there is no motion, or
        times do not overlap.

    Examples
    --------
    >>> t = np.arange(0, 10, 1 / 60)
    >>> found = motion_lag(t, np.sin(3 * (t - 0.05))[:, None], t, np.sin(3 * t)[:, None])
    >>> round(found.seconds, 4)
    0.05
    """
    if min(len(time), len(command_time)) < FEWEST:
        return MotionLag(0.0, 0.0)
    duration = min(np.ptp(time), np.ptp(command_time)) / 2
    step = max(float(np.median(np.diff(time))) / 2, FINEST_S)
    for reach in (min(CLOSE_S, duration), duration):
        lags = step * np.arange(-np.floor(reach / step), np.floor(reach / step) + 1)
        found = np.array(
            [_correlation(time - lag, coordinates, command_time, command) for lag in lags]
        )
        # If a lag near zero has a good correlation, larger lags are not tried.
        if len(found) and found.max() > 1 - 5 * ALIKE:
            break
    if not len(found) or found.max() <= 0:
        return MotionLag(0.0, 0.0)
    good = np.flatnonzero(found >= found.max() - ALIKE)
    nearest = good[np.argmin(np.abs(lags[good]))]
    # From the good lag nearest to zero, climb to the peak to which it belongs.
    best = int(nearest)
    while 0 < best < len(lags) - 1 and found[best] < max(found[best - 1], found[best + 1]):
        best += 1 if found[best + 1] > found[best - 1] else -1
    shift = 0.0
    if 0 < best < len(lags) - 1:
        before, at, after = found[best - 1 : best + 2]
        bend = before - 2 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return MotionLag(float(lags[best] + shift * step), float(found[best]))


def _correlation(time: Array, coordinates: Array, command_time: Array, command: Array) -> float:
    """Return the mean correlation of the joints at these times, or zero without an overlap."""
    inside = (time >= command_time[0]) & (time <= command_time[-1])
    if inside.sum() < FEWEST:
        return 0.0
    held = interpolated(time[inside], command_time, command)
    one, other = held - held.mean(axis=0), coordinates[inside] - coordinates[inside].mean(axis=0)
    scale = np.sqrt((one**2).sum(axis=0) * (other**2).sum(axis=0))
    moving = scale > 0
    if not moving.any():
        return 0.0
    return float(((one * other).sum(axis=0)[moving] / scale[moving]).mean())
