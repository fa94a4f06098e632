"""Delay from a pose to the servo's command for it, found from the sensor's noise.

The visual servo computes a command from each measured pose, and the command has the noise of that
pose. The noise therefore appears in the commands after the delay. The delay is the sum of the
latency and the difference of the clocks of poses and commands. Drives and friction do not affect
it. If no servo used these poses, the commands do not have their noise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from identify.arrays import Array
from identify.record.smoothness import windows_of
from identify.record.telemetry import Telemetry

REACH_S = 0.5
"""Largest delay, s, of either sign that is tried."""

PARTS = 4
"""Number of tried delays per time between two poses."""

CERTAIN = 6.0
"""Smallest correlation, in standard deviations of the correlation of independent noises."""


@dataclass(frozen=True)
class ServoDelay:
    """Delay of a command after its pose.

    Attributes
    ----------
    seconds : float
        Median delay, s. It is negative if the clock of the poses is ahead by more than the latency.
    drift : float
        Growth of the delay, s per s.
    spread : float
        Median deviation from the delay and its drift, s.
    correlation : float
        Correlation of the noise of poses and commands, as joint coordinates.
    resolution : float
        Time between two rows of the commands, s. If there are more commands than poses, a command
        can have been written earlier than its first row by up to this time.
    """

    seconds: float
    drift: float
    spread: float
    correlation: float
    resolution: float


def servo_delay(telemetry: Telemetry, robot: Robot) -> ServoDelay | None:
    """Return the delay of the servo's commands, or None if they show no noise of the poses."""
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
    found = np.array(
        [
            _correlation(
                noise, windows.deviations(_held(telemetry, rows, moments, time + delay)[1])
            )
            for delay in delays
        ]
    )
    # A command is held until the next, so that PARTS delays in a row correlate. Take their middle.
    best = int(np.argmax(np.convolve(np.abs(found), np.ones(PARTS), mode="same")))
    correlation = float(found[best])
    if abs(correlation) * np.sqrt(noise.size) < CERTAIN:
        return None
    held = _held(telemetry, rows, moments, time[windows.rows] + delays[best])[0]
    each = moments[held] - time[windows.rows]
    since = time[windows.rows] - time[windows.rows].mean()
    median = float(np.median(each))
    drift = float(since @ (each - median) / (since @ since))
    return ServoDelay(
        median,
        drift,
        float(np.median(np.abs(each - median - drift * since))),
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
    places = np.maximum(np.searchsorted(moments[rows], time, side="right") - 1, 0)
    return rows[first[places]], command[places]


def _correlation(one: Array, other: Array) -> float:
    """Return the mean correlation of the n columns of two noises (K, n)."""
    product = (one * other).sum(axis=0)
    scale = np.sqrt((one**2).sum(axis=0) * (other**2).sum(axis=0))
    moving = scale > 0
    return float((product[moving] / scale[moving]).mean()) if moving.any() else 0.0
