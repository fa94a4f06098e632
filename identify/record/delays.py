"""Delays of a log: of the motion behind its commands, and of commands behind the servo's poses.

The lag of the motion is determined by correlation. It is the sum of the lag of the drives, the
latency, and the difference of the clocks with which poses and commands are logged.

The delay of the servo is determined from the sensor's noise. The visual servo computes a command
from each measured pose, so the noise of the pose appears in the commands after the delay. The delay
is the sum of the latency and the difference of the clocks. Drives and friction do not affect it. If
no servo used these poses, their noise does not appear in the commands.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from identify.arrays import Array
from identify.filtering import interpolated
from identify.record.smoothness import windows_of
from identify.record.telemetry import Telemetry

# Smallest step, s, of the lags that are tried. A parabola then refines the lag that is chosen.
FINEST_S = 1e-3
# Largest lag, s, that is tried first. Larger lags can be wrong by a period of the motion.
CLOSE_S = 1.0
GOOD = 0.9  # correlation above which no lags larger than CLOSE_S are tried
# Difference from the highest correlation up to which a lag nearer to zero is taken.
ALIKE = 0.02
MOST_ROWS = 1000  # largest number of poses with which a lag is tried
MOST_LAGS = 5000  # largest number of lags of one sign that are tried
FEWEST = 8  # smallest number of poses that overlap with commands


@dataclass(frozen=True)
class MotionLag:
    """Lag, s, positive where the motion is later, and the correlation (-1 to 1) at this lag."""

    seconds: float
    correlation: float


def motion_lag(time: Array, coordinates: Array, command_time: Array, command: Array) -> MotionLag:
    """Return the lag at which joint coordinates follow commands best.

    time (N,)           Times of the coordinates, s.
    coordinates (N, n)  Joint coordinates at measured poses.
    command_time (M,)   Times of the commands, s.
    command (M, n)      Joint commands.

    The lag is at most half the duration of the shorter log. Lag and correlation are zero if there
    is no motion, there are too few rows, the times do not overlap, or no correlation is positive.
    """
    if min(len(time), len(command_time)) < FEWEST:
        return MotionLag(0.0, 0.0)
    duration = min(np.ptp(time), np.ptp(command_time)) / 2
    fine = max(float(np.median(np.diff(time))) / 2, FINEST_S)
    # Rows spread over the log are enough, and long logs have many lags to try.
    every = -(-len(time) // MOST_ROWS)
    rows, moved = time[::every], coordinates[::every]

    def scores_at(lags: Array) -> Array:
        return np.array([_correlation(rows - lag, moved, command_time, command) for lag in lags])

    for reach in (min(CLOSE_S, duration), duration):
        step = max(fine, reach / MOST_LAGS)
        lags = step * np.arange(-np.floor(reach / step), np.floor(reach / step) + 1)
        scores = scores_at(lags)
        if len(scores) and scores.max() > GOOD:
            break
    if not len(scores) or scores.max() <= 0:
        return MotionLag(0.0, 0.0)
    good = np.flatnonzero(scores >= scores.max() - ALIKE)
    nearest = good[np.argmin(np.abs(lags[good]))]
    best = _peak(scores, int(nearest))
    if step > fine:
        around = np.ceil(step / fine)
        lags = lags[best] + fine * np.arange(-around, around + 1)
        step = fine
        scores = scores_at(lags)
        best = int(np.argmax(scores))
    shift = 0.0
    if 0 < best < len(lags) - 1:
        before, peak, after = scores[best - 1 : best + 2]
        curvature = before - 2 * peak + after
        shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return MotionLag(float(lags[best] + shift * step), float(scores[best]))


def _peak(scores: Array, start: int) -> int:
    """Return the index of the peak to which an index of scores belongs."""
    best = start
    while 0 < best < len(scores) - 1 and scores[best] < max(scores[best - 1], scores[best + 1]):
        best += 1 if scores[best + 1] > scores[best - 1] else -1
    return best


def _correlation(time: Array, coordinates: Array, command_time: Array, command: Array) -> float:
    """Return the mean correlation of the joints at these times, or zero without an overlap."""
    inside = (time >= command_time[0]) & (time <= command_time[-1])
    if inside.sum() < FEWEST:
        return 0.0
    commanded = interpolated(time[inside], command_time, command)
    followed = coordinates[inside]
    return _mean_correlation(commanded - commanded.mean(axis=0), followed - followed.mean(axis=0))


REACH_S = 0.5  # largest delay, s, of either sign that is tried
PARTS = 4  # number of delays that are tried within the usual time between two poses
# Correlation below which no delay is stated, in standard deviations of the correlation of
# independent noises.
CERTAIN = 6.0


@dataclass(frozen=True)
class ServoDelay:
    """Delay of a command after its pose.

    seconds      Median delay, s. It is negative if the clock of the poses is ahead by more than the
                 latency.
    drift        Growth of the delay, s per s.
    spread       Median of the absolute deviations from the delay with its drift, s.
    correlation  Correlation of the noises of commands and poses, both in joint coordinates.
    resolution   Usual time between two rows of commands, s. If most rows only repeat the command
                 before, a command can have been written up to this time before its first row.
    """

    seconds: float
    drift: float
    spread: float
    correlation: float
    resolution: float


def servo_delay(telemetry: Telemetry, robot: Robot) -> ServoDelay | None:
    """Return the delay of the servo's commands.

    Returns None if the commands show no noise of the poses, or too few poses are in reach.
    """
    log = telemetry.poses
    time = log.time[log.ok]
    poses = np.asarray(robot.pose(robot.coordinates(log.pose[log.ok])))
    reached = (robot.reach_margin(poses) > 0).all(axis=-1)
    time, joints = time[reached], robot.inverse_kinematics(poses[reached])
    windows = windows_of(time)
    if not len(windows.rows):
        return None
    noise = windows.deviations(joints)
    moments = _written(telemetry)
    rows = np.flatnonzero(np.isfinite(moments))
    step = float(np.median(np.diff(time))) / PARTS
    reach = np.ceil(REACH_S / step)
    delays = step * (np.arange(-reach, reach + 1) + 0.5)
    correlations = np.array(
        [
            _mean_correlation(
                noise, windows.deviations(_held(telemetry, rows, moments, time + delay)[1])
            )
            for delay in delays
        ]
    )
    # A command is held until the next, so PARTS successive delays correlate. Take their middle.
    best = int(np.argmax(np.convolve(np.abs(correlations), np.ones(PARTS), mode="same")))
    correlation = float(correlations[best])
    if abs(correlation) * np.sqrt(noise.size) < CERTAIN:
        return None
    held = _held(telemetry, rows, moments, time[windows.rows] + delays[best])[0]
    row_delays = moments[held] - time[windows.rows]
    since = time[windows.rows] - time[windows.rows].mean()
    median = float(np.median(row_delays))
    drift = float(since @ (row_delays - median) / (since @ since))
    return ServoDelay(
        median,
        drift,
        float(np.median(np.abs(row_delays - median - drift * since))),
        correlation,
        float(np.median(np.diff(telemetry.commands.time))),
    )


def _written(telemetry: Telemetry) -> Array:
    """Return the times (M,) at which commands were written, or else the times of their rows."""
    commands = telemetry.commands
    return commands.time if commands.written is None else commands.written


def _held(
    telemetry: Telemetry, rows: NDArray[np.intp], moments: Array, time: Array
) -> tuple[NDArray[np.intp], Array]:
    """Return the rows (K,) in which the commands at times (K,) first appear, and the commands."""
    command = telemetry.commands.command[rows]
    changed = np.concatenate([[True], (np.diff(command, axis=0) != 0).any(axis=1)])
    first = np.maximum.accumulate(np.where(changed, np.arange(len(rows)), 0))
    newest = np.maximum(np.searchsorted(moments[rows], time, side="right") - 1, 0)
    return rows[first[newest]], command[newest]


def _mean_correlation(first: Array, second: Array) -> float:
    """Return the mean correlation of the n columns of two arrays (K, n) with mean zero."""
    product = (first * second).sum(axis=0)
    scale = np.sqrt((first**2).sum(axis=0) * (second**2).sum(axis=0))
    moving = scale > 0
    return float((product[moving] / scale[moving]).mean()) if moving.any() else 0.0
