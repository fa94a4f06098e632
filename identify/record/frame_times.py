"""Times of poses: those that a log states, or frames one period apart.

Cameras are triggered by a clock, but logs round times or write them late. Poses of a moving robot
show which times are right: as a function of the right times, the poses lie on smoother curves.
"""

import numpy as np

from identify.arrays import Array
from identify.record.smoothness import local_misfit

GAP = 1.5  # time between two rows, as a multiple of the usual time, above which rows are missing
# Largest distance of a stated time from its frame, in periods.
FARTHEST = 0.4
# Ratio of the misfit at the frames to that at the stated times, below which the frames are taken.
BETTER = 0.97


def mean_rate(times: Array) -> float:
    """Return the rate, Hz, of rows at times (N,), s, without their gaps.

    If times are rounded, for example to milliseconds, their median interval does not give the rate.
    """
    steps = np.diff(times)
    steps = steps[steps > 0]
    usual = float(np.median(steps))
    return 1.0 / float(steps[np.abs(steps - usual) <= (GAP - 1.0) * usual].mean())


def frame_grid(times: Array, rate_hz: float) -> Array | None:
    """Return times (N,) of frames one period apart that are nearest to stated times (N,), s.

    Frames can be missing. The period is fitted to the times, and is near that of rate_hz. Returns
    None if some time is too far from every frame, or two times are nearest to the same frame.
    """
    steps = np.rint(np.diff(times) * rate_hz)  # in frames
    frames = np.concatenate([[0.0], np.cumsum(steps)])
    if (steps < 1).any():
        return None
    slope, start = np.polyfit(frames, times, 1)
    grid = start + slope * frames
    return grid if np.abs(times - grid).max() <= FARTHEST / rate_hz else None


def likelier_times(times: Array, poses: Array, covariance: Array, rate_hz: float) -> Array:
    """Return the times (N,), s, at which poses are more likely to have been seen.

    These are the stated times, or the nearest frames if the poses are smoother there.

    times (N,)         Stated times of measured poses, s.
    poses (N, 6)       Measured poses, without lost ones.
    covariance (6, 6)  Covariance of a pose.
    rate_hz            Frame rate.
    """
    grid = frame_grid(times, rate_hz)
    if grid is None:
        return times
    stated, framed = (local_misfit(one, poses, covariance) for one in (times, grid))
    return grid if framed < BETTER * stated else times


def missing_rows(time: Array, rate_hz: float) -> int:
    """Return how many frames between the first and the last of times (N,), s, have no row.

    The number is 0 if the frames were faster than ``rate_hz``.
    """
    return max(0, round(float(np.ptp(time)) * rate_hz) + 1 - len(time))
