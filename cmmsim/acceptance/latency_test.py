"""Latency in the style of ASTM E3124: the time from a pose to the report of this pose.

A body moves on a circle, and its true position is known at every time. The reported positions are
compared with the true motion at the times of the reports. The latency is the time shift of the true
motion that fits the reports best. Frames are tracked one after the other, because the tracker is
part of the instrument under test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cmmsim.acceptance.artefacts import (
    HALF_LENGTH,
    HALF_WIDTH,
    SensorUnderTest,
    estimator_of,
    locate,
    rigid_bar,
)
from cmmsim.acceptance.statistics import Interval, interval_of_mean
from cmmsim.acceptance.volume import MeasuringVolume
from cmmsim.errors import AcceptanceError, ShapeError
from cmmsim.geometry.pose import Array, apply
from cmmsim.tracker import Tracker

STREAM = 201  # number that selects the random noise
# Radius of the circle in m, and time of one revolution in s. The speed is 0.31 m/s.
RADIUS = 0.05
PERIOD = 1.0
FRAMES = 180  # number of frames
# Step of the central differences of a motion, s.
STEP = 1e-5
# Number of least-squares steps. The first half estimates a common delay, the rest single delays.
ITERATIONS = 8
Motion = Callable[[Array], Array]
"""Function that returns true positions (n,3) m at times (n,) s."""


@dataclass(frozen=True)
class Latency:
    """Delays (n,) of the reports, s, with their mean, standard deviation and maximum.

    ``interval`` is the 95 % interval of the mean. ``resolution`` is the standard deviation that the
    noise of the positions causes in a single delay.
    """

    delays: Array
    mean: float
    std: float
    maximum: float
    interval: Interval
    resolution: float


@dataclass(frozen=True)
class LatencyTest:
    """Result of a latency test.

    ``latency`` is the estimated latency, and ``stated`` the latency in the sensor file, s.
    ``reported`` (n,) are the times of the reports, s. ``frame_period`` is in s, and ``lost`` is the
    number of lost frames.
    """

    latency: Latency
    reported: Array
    stated: float
    frame_period: float
    lost: int


def estimate_latency(
    reported: Array,
    positions: Array,
    motion: Motion,
    largest: float,
    covariances: Array | None = None,
) -> Latency:
    """Estimate the delay of each report by least squares.

    The model is positions(k) = motion(reported(k) - delay(k)) + offset. The constant offset (3,) is
    estimated as well, but not returned. Reports are at times ``reported`` (n,) s with ``positions``
    (n, 3) m and ``covariances`` (n, 3, 3) m². The search begins with common delays from 0 to
    ``largest`` s, which must be at most half the period of the motion. Raises ShapeError for fewer
    than four reports, for positions of another shape, and for a motion that stands still.
    """
    if len(reported) < 4 or positions.shape != (len(reported), 3):
        raise ShapeError(
            f"latency needs four reports or more with positions (n,3), got {len(reported)} and "
            f"{positions.shape}"
        )
    delays = np.full(len(reported), _coarse_delay(reported, positions, motion, largest))
    offset = np.zeros(3)
    for iteration in range(ITERATIONS):
        times = reported - delays
        velocity = (motion(times + STEP) - motion(times - STEP)) / (2.0 * STEP)
        squared_speed = np.sum(velocity**2, axis=1)
        if squared_speed.min() < 1e-8:
            raise ShapeError(
                "latency needs a motion without standstill: its lowest speed is "
                f"{1e3 * np.sqrt(squared_speed.min()):.3g} mm/s, but at least 0.1 mm/s is needed"
            )
        residuals = positions - motion(times) - offset
        # one common delay and the offset are estimated first, then each delay separately
        if iteration < ITERATIONS // 2:
            common, offset_change = _common_step(residuals, velocity)
            delays = delays + common
            offset = offset + offset_change
        else:
            delays = delays - np.sum(residuals * velocity, axis=1) / squared_speed
    return Latency(
        delays,
        float(delays.mean()),
        float(delays.std(ddof=1)),
        float(delays.max()),
        interval_of_mean(delays),
        _resolution(velocity, covariances),
    )


def require_room(volume: MeasuringVolume) -> None:
    """Raise AcceptanceError unless the whole body stays inside the volume on its circle."""
    needed = 2.0 * np.array([HALF_LENGTH + RADIUS, HALF_WIDTH + RADIUS, 0.0])
    if np.any(needed > volume.size):
        raise AcceptanceError(
            f"latency: the body on its circle needs {1e3 * needed[0]:.0f} x {1e3 * needed[1]:.0f} "
            f"mm across the line of sight, but the volume has {volume}"
        )


def latency_test(
    under_test: SensorUnderTest,
    volume: MeasuringVolume,
    frames: int = FRAMES,
    advance: Callable[[], None] = lambda: None,
) -> LatencyTest:
    """Move a body on a circle in the middle of the volume, and estimate the latency of the reports.

    ``advance`` is called after each frame. Raises AcceptanceError if the volume is too small, if
    the body is not found in the first image, or if fewer than four frames are measured.
    """
    require_room(volume)
    sensor = under_test.facing(rigid_bar(), STREAM)
    estimator = estimator_of(sensor, sensor.platform, under_test.base_from_camera)

    def pose(time: float) -> Array:
        return volume.pose(np.array([1.0, 0.0, 0.0]), _circle(np.array([time]))[0])

    def rate(time: float) -> Array:
        return (pose(time + STEP) - pose(time - STEP)) / (2.0 * STEP)

    def motion(times: Array) -> Array:
        return apply(volume.base_from_volume, _circle(times))

    # if the body cannot be found, the exception is raised here, before the frames are tracked
    locate(estimator, sensor.look(pose(0.0)))
    tracker = Tracker(estimator)
    taken = np.arange(frames) / sensor.timing.frame_rate
    measured = []
    for time in taken:
        measured.append(tracker.measure(sensor.look(pose(time), pose_rate=rate(time))))
        advance()
    good = np.array([m.ok for m in measured])
    if good.sum() < 4:
        raise AcceptanceError(
            f"latency: {good.sum()} of {frames} frames are measured: {measured[-1].reason}"
        )
    reported = (
        taken
        + sensor.timing.drawn_latencies(frames, np.random.default_rng([under_test.seed, STREAM]))
    )[good]
    positions = np.array([m.pose[:3] for m in measured])[good]
    covariances = np.array([m.covariance[:3, :3] for m in measured])[good]
    latency = estimate_latency(reported, positions, motion, 0.5 * PERIOD, covariances)
    return LatencyTest(
        latency, reported, sensor.timing.latency, 1.0 / sensor.timing.frame_rate, int((~good).sum())
    )


def _circle(times: Array) -> Array:
    """Return positions (n, 3) in volume axes on a circle across the line of sight."""
    angle = 2.0 * np.pi * times / PERIOD
    return RADIUS * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(times))])


def _coarse_delay(reported: Array, positions: Array, motion: Motion, largest: float) -> float:
    """Return the delay on a grid, common to all reports, with the smallest variance of residuals.

    The variance does not depend on a constant offset.
    """
    grid = np.linspace(0.0, largest, 101)
    misfit = [np.var(positions - motion(reported - delay), axis=0).sum() for delay in grid]
    return float(grid[int(np.argmin(misfit))])


def _common_step(residuals: Array, velocity: Array) -> tuple[float, Array]:
    """Return least-squares changes of the common delay and of the offset (3,)."""
    columns = np.zeros((residuals.size, 4))
    columns[:, 0] = -velocity.ravel()
    columns[:, 1:] = np.tile(np.eye(3), (len(residuals), 1))
    solution = np.linalg.lstsq(columns, residuals.ravel(), rcond=None)[0]
    return float(solution[0]), np.asarray(solution[1:], dtype=np.float64)


def _resolution(velocity: Array, covariances: Array | None) -> float:
    """Return the standard deviation of a delay due to the noise of positions, rms over reports.

    The result is 0 without covariances.
    """
    if covariances is None:
        return 0.0
    variances = (
        np.einsum("ni,nij,nj->n", velocity, covariances, velocity)
        / np.sum(velocity**2, axis=1) ** 2
    )
    return float(np.sqrt(variances.mean()))
