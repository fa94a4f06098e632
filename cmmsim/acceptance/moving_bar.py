"""Relative pose error of a moving rigid bar in the style of ASTM E3064-16.

The bar moves along two rasters, each in three orientations. At the start of each raster, it first
stands still. One raster goes to and fro along the volume's x axis while it advances along y. The
other raster exchanges these axes. The bar lies along x in the first orientation, along y in the
second, and is inclined to the image plane by ``TOWARDS_DEPTH`` in the third. It never points at the
cameras, because they would not see its flat stickers then. In addition, it rotates smoothly about
all its axes.

The sensor measures the poses of the sticker clusters at both ends in the same exposure. The
measured pose of one end relative to the other is compared with the certified relative pose, for the
bar at rest and for the moving bar. Frames are tracked one after the other, because the tracker is
part of the instrument under test.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.acceptance.artefacts import (
    FIRST_FROM_SECOND,
    HALF_LENGTH,
    HALF_WIDTH,
    SensorUnderTest,
    bar_ends,
    estimator_of,
    locate,
    rigid_bar,
)
from cmmsim.acceptance.volume import MeasuringVolume
from cmmsim.errors import AcceptanceError
from cmmsim.geometry.pose import (
    Array,
    compose_covariance,
    euler_rates_matrix,
    invert,
    pose_to_transform,
    rotation_exp,
    rotation_log,
    skew,
)
from cmmsim.measuring.measurement import Measurement
from cmmsim.sensor import Sensor
from cmmsim.tracker import Tracker

# Duration of the motion in a run, s, and number of movements to and fro in this time.
SECONDS = 3.0
CYCLES = 1.5
# Amplitude of the rotation about each axis, rad, and number of its cycles in a run.
TURN = np.deg2rad(8.0)
TURN_CYCLES = np.array([1.0, 1.5, 0.5])
# Angle of the bar to the image plane in the third orientation, rad.
TOWARDS_DEPTH = np.deg2rad(35.0)
# Time step of the difference quotient of a path, s.
STEP = 1e-4
# Number of times at which the speed is computed to find its maximum.
SPEED_SAMPLES = 100
# Number that selects the random noise of the first run. The next runs have the next numbers.
STREAM = 101
# Number of exposures of the bar at rest at the start of each run.
STANDING_FRAMES = 15
# Number of consecutive lost frames that ends a run. Further frames would probably be lost as well,
# and the search of the whole images after each lost frame takes time.
MOST_LOST_FRAMES = 5
# Index of the axis along which the bar moves to and fro, by the name of the raster.
RASTERS = {"x": 0, "y": 1}
# Direction of the bar in volume axes.
ORIENTATIONS = {
    "along x": np.array([1.0, 0.0, 0.0]),
    "along y": np.array([0.0, 1.0, 0.0]),
    "towards depth": np.array([np.cos(TOWARDS_DEPTH), 0.0, np.sin(TOWARDS_DEPTH)]),
}


@dataclass(frozen=True)
class BarPath:
    """Path of the bar in a volume.

    ``fast`` is the index of the axis along which the bar moves to and fro. ``along`` (3,) is the
    direction of the bar in volume axes.
    """

    name: str
    fast: int
    along: Array
    volume: MeasuringVolume

    def pose(self, time: float) -> Array:
        """Return the pose (6,) of the bar in the base frame, ``time`` s after its start from rest.

        The speed is zero at time 0.
        """
        phase = 2.0 * np.pi * time / SECONDS
        position = -np.cos(0.5 * phase) * self.reach
        position[self.fast] = -np.cos(CYCLES * phase) * self.reach[self.fast]
        turn = rotation_exp(-TURN * np.cos(TURN_CYCLES * phase))
        return self.volume.pose(self.along, position, turn)

    def pose_rate(self, time: float) -> Array:
        """Return the time derivative (6,) of the pose, from central differences."""
        return (self.pose(time + STEP) - self.pose(time - STEP)) / (2.0 * STEP)

    @property
    def largest_speed(self) -> float:
        """Largest speed of the bar's middle, m/s."""
        times = np.linspace(0.0, SECONDS, SPEED_SAMPLES)
        return max(float(np.linalg.norm(self.pose_rate(time)[:3])) for time in times)

    @property
    def reach(self) -> Array:
        """Largest distances (3,), m, of the bar's middle from the middle of the volume.

        At these distances, the whole bar is still inside the volume.
        """
        return 0.5 * self.volume.size - room_of_bar(self.along)


def room_of_bar(along: Array) -> Array:
    """Return half the sides (3,), m, of a cuboid that contains a bar rotated by up to TURN."""
    across = HALF_WIDTH + HALF_LENGTH * np.sqrt(3.0) * np.sin(TURN)
    return np.asarray(HALF_LENGTH * np.abs(along) + across * np.sqrt(1.0 - along**2))


def bar_paths(volume: MeasuringVolume) -> tuple[BarPath, ...]:
    """Return the six paths in a volume. Raises AcceptanceError if the bar does not fit into it."""
    paths = tuple(
        BarPath(f"raster {raster}, bar {name}", axis, along, volume)
        for raster, axis in RASTERS.items()
        for name, along in ORIENTATIONS.items()
    )
    for path in paths:
        if path.reach.min() <= 0.0:
            needed = " x ".join(f"{2e3 * v:.0f}" for v in room_of_bar(path.along))
            raise AcceptanceError(
                f"{path.name}: the bar needs {needed} mm, but the volume has {volume}"
            )
    return paths


@dataclass(frozen=True)
class BarRun:
    """One run of the bar, which begins to move at time 0.

    time             (n,), times of the measured frames, s
    errors           (n, 6), errors of the relative pose as shift and rotation vector, in axes of
                     the first end, m and rad
    distance_errors  (n,), errors of the distance between the ends, m
    variance_ratios  (n,), squared Mahalanobis distances of the errors, divided by 6
    lost             number of frames in which an end was not measured
    given_up         reason if the run has ended early, otherwise empty

    If MOST_LOST_FRAMES consecutive frames are lost, the run ends, and its remaining frames count as
    lost.
    """

    name: str
    time: Array
    errors: Array
    distance_errors: Array
    variance_ratios: Array
    lost: int
    given_up: str = ""

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Mask of the frames (n,) that show the moving bar."""
        return self.time >= 0.0


@dataclass(frozen=True)
class BarTest:
    """Result of the bar test.

    ``exposure`` is the exposure time, s. ``largest_speed`` is the largest speed of the bar, m/s.
    """

    volume: MeasuringVolume
    runs: tuple[BarRun, ...]
    exposure: float
    largest_speed: float

    @property
    def frames(self) -> int:
        """Number of frames of all runs, measured or lost."""
        return sum(len(run.time) + run.lost for run in self.runs)

    @property
    def lost(self) -> int:
        """Number of lost frames of all runs."""
        return sum(run.lost for run in self.runs)

    def errors(self, moving: bool) -> Array:
        """Return the errors (n, 6), m and rad, of the bar in motion or at rest in all runs."""
        return np.concatenate([run.errors[run.moving == moving] for run in self.runs])

    def distance_errors(self, moving: bool) -> Array:
        """Return the errors (n,) of the ends' distance, m, in motion or at rest in all runs."""
        return np.concatenate([run.distance_errors[run.moving == moving] for run in self.runs])

    @property
    def variance_ratio(self) -> float:
        """Mean of the variance ratios of all frames.

        It is about 1 if the stated covariances are right.
        """
        return float(np.concatenate([run.variance_ratios for run in self.runs]).mean())


def bar_test(
    under_test: SensorUnderTest,
    volume: MeasuringVolume,
    seconds: float = SECONDS,
    standing: int = STANDING_FRAMES,
    advance: Callable[[], None] = lambda: None,
) -> BarTest:
    """Move the bar along the six paths of a volume, and measure its relative pose errors.

    In each run, the bar is measured in ``standing`` exposures at rest and in the first ``seconds``
    of its motion. ``advance`` is called after each run. Raises AcceptanceError if the bar does not
    fit into the volume, or if it is not found in the first images.
    """
    sensor = under_test.facing(rigid_bar(), STREAM)
    rate = sensor.timing.frame_rate
    times = np.arange(-standing, int(np.ceil(seconds * rate))) / rate
    paths = bar_paths(volume)
    runs = []
    for number, path in enumerate(paths):
        sensor.start_run(under_test.seed + 1000 * (STREAM + number))
        runs.append(bar_run(sensor, path, times))
        advance()
    return BarTest(
        volume, tuple(runs), sensor.timing.exposure, max(path.largest_speed for path in paths)
    )


def bar_run(sensor: Sensor, path: BarPath, times: Array) -> BarRun:
    """Measure the bar at ``times`` (n,) s of a path. Before time 0, the bar stands still.

    Raises AcceptanceError if an end is not found in the first image, or if the bar is not measured
    both at rest and in motion.
    """
    estimators = [estimator_of(sensor, end) for end in bar_ends(sensor.platform)]
    for estimator in estimators:
        # if an end cannot be found, the exception is raised here, before the frames are tracked
        locate(estimator, sensor.look(path.pose(0.0)))
    trackers = [Tracker(estimator) for estimator in estimators]
    rows = []
    seen = []
    lost_in_a_row = 0
    reason = ""
    for time in times:
        images = sensor.look(
            path.pose(max(time, 0.0)), pose_rate=path.pose_rate(time) if time > 0.0 else None
        )
        first, second = (tracker.measure(images) for tracker in trackers)
        if first.ok and second.ok:
            lost_in_a_row = 0
            seen.append(time)
            rows.append(relative_error(first, second))
        else:
            lost_in_a_row = lost_in_a_row + 1
            reason = first.reason or second.reason
            if lost_in_a_row == MOST_LOST_FRAMES:
                break
    if not (seen and seen[0] < 0.0 <= seen[-1]):
        raise AcceptanceError(
            f"{path.name}: the bar was not measured at rest, or not in motion: {reason}"
        )
    errors, distances, ratios = (np.array(column) for column in zip(*rows, strict=True))
    given_up = reason if lost_in_a_row == MOST_LOST_FRAMES else ""
    return BarRun(
        path.name, np.array(seen), errors, distances, ratios, len(times) - len(seen), given_up
    )


def relative_error(first: Measurement, second: Measurement) -> tuple[Array, float, float]:
    """Return the error (6,) of the second end's pose relative to the first end.

    The error is a shift and a rotation vector in axes of the first end. The second result is the
    error of the ends' distance, m. The third result is the squared Mahalanobis distance of the
    error, divided by 6.
    """
    measured = invert(pose_to_transform(first.pose)) @ pose_to_transform(second.pose)
    rotation_error = rotation_log(measured[:3, :3] @ FIRST_FROM_SECOND[:3, :3].T)
    error = np.concatenate([measured[:3, 3] - FIRST_FROM_SECOND[:3, 3], rotation_error])
    distance = float(np.linalg.norm(measured[:3, 3]) - np.linalg.norm(FIRST_FROM_SECOND[:3, 3]))
    covariance = relative_covariance(first, second)
    return error, distance, float(error @ np.linalg.solve(covariance, error)) / 6.0


def relative_covariance(first: Measurement, second: Measurement) -> Array:
    """Return the covariance (6, 6) of the small error [shift, rotation] of the relative pose.

    The error is in axes of the first end.
    """
    by_first = -np.eye(6)
    # a rotation of the first end shifts the second end, because there is a lever between them
    by_first[:3, 3:] = skew(second.pose[:3] - first.pose[:3])
    total = by_first @ _small_covariance(first) @ by_first.T + _small_covariance(second)
    return compose_covariance(invert(pose_to_transform(first.pose)), total)


def _small_covariance(measurement: Measurement) -> Array:
    """Return the covariance (6, 6) of a pose's small error [shift, rotation vector].

    It is computed from the measurement's covariance, which is for Euler angles.
    """
    jacobian = np.eye(6)
    jacobian[3:, 3:] = euler_rates_matrix(measurement.pose)
    return np.asarray(jacobian @ measurement.covariance @ jacobian.T)
