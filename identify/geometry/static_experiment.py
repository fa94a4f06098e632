"""Simulated calibration: encoders and sensor measure a robot with geometry errors at rest.

The joints move to commanded coordinates of the encoders. The pose of the platform follows from the
true geometry, which includes the offsets of the encoders. Poses are measured through images, or
drawn with the noise that the sensor states.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import cmmsim
from cmmsim.errors import LostError
from cmmsim.visibility import SightLines, stated_covariance
from dynamics import Robot
from dynamics.closure import Closure
from dynamics.errors import ConvergenceError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.experiment.leg_bodies import robot_transforms
from identify.geometry.calibration import measured_poses
from identify.geometry.static_poses import FrameKnowledge, StaticPoses
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import ENCODERS, NOISE, STATIC_NOISE, child, stream_seed
from identify.record.stored_common_errors import CommonErrors, kind_of
from identify.scenario.sections import Geometry

# Number of the sensor's run at the first pose, above the numbers of an experiment's motions.
FIRST_POSE_RUN = 2_000_000
# Largest difference, due to friction, between commanded and actual joint coordinates, as a fraction
# of the travel. The encoders read the actual coordinates.
REST = 1e-3


@dataclass(frozen=True)
class Encoders:
    """Encoders of a robot's joints, rad or m.

    noise: standard deviation of one reading. resolution: quantisation step, or zero. offset:
    standard deviation of the offsets.
    """

    noise: float
    resolution: float
    offset: float

    def mean_std(self, readings: int) -> float:
        """Return the standard deviation of the mean of readings of a joint at rest.

        The quantisation error is a sawtooth function of the joint coordinate. Its k-th harmonic has
        the amplitude 1 / (pi k) steps. Averaging readings with noise of s steps reduces this
        amplitude by the factor exp(-2 (pi k s)^2).
        """
        if not self.resolution:
            return self.noise / readings**0.5
        # The squared harmonics decrease as 1 / k^2, so 29 are enough.
        waves = np.pi * np.arange(1, 30)
        steps = self.noise / self.resolution
        kept = self.resolution**2 * np.sum(np.exp(-4 * (waves * steps) ** 2) / waves**2) / 2
        return float(np.sqrt(kept + (self.noise**2 + self.resolution**2 / 12 - kept) / readings))

    def read(self, joints: Array, readings: int, rng: np.random.Generator) -> Array:
        """Return the means (N, n) of readings of joint coordinates (N, n)."""
        each = joints + self.noise * rng.standard_normal((readings, *joints.shape))
        step = self.resolution
        return np.asarray((step * np.round(each / step) if step else each).mean(axis=0))


def encoders_of(robot: Robot, settings: Geometry) -> Encoders:
    """Return the encoders of a scenario's calibration, for actuators that turn or slide."""
    return Encoders(
        noise=of_actuators(robot, settings, "encoder_noise"),
        resolution=of_actuators(robot, settings, "encoder_resolution"),
        offset=of_actuators(robot, settings, "encoder_offset"),
    )


def true_poses(robot: Robot, deviations: Array, joints: Array, start: Array) -> Array:
    """Return the poses (N, 6), near `start`, of the true robot for encoder readings (N, n).

    Raises EstimationError if the robot cannot reach a pose. The message names the pose.
    """
    try:
        return Closure(robot.geometry).poses(joints, deviations, start)
    except ConvergenceError as error:
        raise EstimationError(f"the true robot does not reach a pose: {error}") from error


@dataclass(frozen=True)
class MeasuredPlatform:
    """Measured static poses.

    poses (N, 6)           Means of the measured frames, m and rad.
    covariances (N, 6, 6)  Covariances of the means, NaN without a measured frame.
    seen (N,)              True for poses with at least one measured frame.
    lost                   Number of lost frames.
    """

    poses: Array
    covariances: Array
    seen: NDArray[np.bool_]
    lost: int


def measured(
    sensor: cmmsim.Sensor, robot: Robot, poses: Array, frames: int, seed: int, progress: Progress
) -> MeasuredPlatform:
    """Measure poses (N, 6) through images, each as the mean of frames.

    Averaging reduces only the part of the stated variance that appears as scatter of frames at
    rest. Constant errors, for example of rendering and detection, remain in the covariance of the
    mean.
    """
    means = np.full_like(poses, np.nan)
    stated = np.full((len(poses), 6, 6), np.nan)
    scatter = 0.0
    spare = 0
    counts = np.zeros(len(poses), dtype=int)
    with progress.stage("measure poses", len(poses) * frames) as advance:
        for row, pose in enumerate(poses):
            bodies = robot_transforms(robot, pose)
            # Each pose has its own stream, so a lost frame does not change the noise at others.
            sensor.start_run(stream_seed(seed, NOISE, FIRST_POSE_RUN + row))
            values, covariances = _frames_at(sensor, pose, bodies, frames)
            advance(frames)
            if len(values):
                means[row] = values.mean(axis=0)
                counts[row] = len(values)
                stated[row] = covariances.mean(axis=0)
                away = values - means[row]
                weighted = np.linalg.solve(stated[row], away.T).T
                scatter += float(np.sum(away * weighted)) / away.shape[1]
                spare += len(values) - 1
    seen = counts > 0
    # If no pose has several frames, no scatter is known, and the variance is not reduced.
    fraction = min(scatter / spare, 1.0) if spare else 0.0
    kept = 1 - fraction * (1 - 1 / np.maximum(counts, 1))
    lost = int(len(poses) * frames - counts.sum())
    return MeasuredPlatform(means, stated * kept[:, None, None], seen, lost)


def _frames_at(
    sensor: cmmsim.Sensor, pose: Array, bodies: Mapping[str, Array], frames: int
) -> tuple[Array, Array]:
    """Return poses (k, 6) and covariances (k, 6, 6) of the measured frames at a pose.

    Frames are searched as whole images until a pose is measured. In all later frames, stickers are
    searched near this pose.
    """
    due = frames
    while due:
        first = sensor.measure(pose, bodies)
        due = due - 1
        if not first.ok:
            continue
        rest = sensor.measure_many(
            np.tile(pose, (due, 1)), obstacles=bodies, near=np.tile(first.pose, (due, 1))
        )
        ok = rest.stickers > 0
        return np.stack([first.pose, *rest.poses[ok]]), np.stack(
            [first.covariance, *rest.covariances[ok]]
        )
    return np.zeros((0, 6)), np.zeros((0, 6, 6))


def drawn(
    sensor: cmmsim.Sensor,
    sight: SightLines,
    poses: Array,
    frames: int,
    rng: np.random.Generator,
    progress: Progress,
) -> MeasuredPlatform:
    """Draw measured poses without images.

    The stated covariance of one frame at each pose, divided by `frames`, is the covariance of the
    drawn mean. Errors of the base and platform frames, with the covariance of teaching, and errors
    of inexact cameras are drawn once for all poses.
    """
    taught = sensor.taught
    known = FrameKnowledge(taught.base_covariance, taught.platform_covariance)
    offset = known.root @ rng.standard_normal(12)
    covariances = np.full((len(poses), 6, 6), np.nan)
    seen = np.zeros(len(poses), dtype=bool)
    with progress.stage("draw poses", len(poses)) as advance:
        for row, pose in enumerate(poses):
            with suppress(LostError):
                covariances[row] = stated_covariance(sensor, sight, pose) / frames
                seen[row] = True
            advance()
    means = measured_poses(poses, offset)
    if (by_cameras := camera_errors(sensor, poses)) is not None:
        means = means + by_cameras @ rng.standard_normal(by_cameras.shape[2])
    for row in map(int, np.flatnonzero(seen)):
        means[row] += np.linalg.cholesky(covariances[row]) @ rng.standard_normal(6)
    return MeasuredPlatform(means, covariances, seen, int((~seen).sum()) * frames)


def camera_errors(sensor: cmmsim.Sensor, poses: Array) -> Array | None:
    """Return the shift (N, 6, k) of poses (N, 6) at rest by k independent camera errors.

    Each error has variance one and is the same for all poses. None means that the cameras count as
    exact, as with any pose method other than registration.
    """
    if sensor.method != "registration":
        return None
    found = sensor.common_errors(poses, np.zeros_like(poses))
    kept = [k for k, name in enumerate(found.names) if kind_of(name) == "rig"]
    if not kept:
        return None
    names = tuple(found.names[k] for k in kept)
    within = found.covariance[np.ix_(kept, kept)]
    return CommonErrors(names, found.changes[:, :, kept], within).modes


def measure_static_poses(
    robot: Robot,
    settings: Geometry,
    sensor: cmmsim.Sensor,
    sight: SightLines,
    deviations: Array,
    joints: Array,
    start: Array,
    seed: int,
    progress: Progress,
) -> tuple[StaticPoses, int]:
    """Measure the true robot at rest after it has moved to joint coordinates (N, n).

    robot                           Nominal robot.
    sensor                          Taught sensor.
    sight                           Stickers and cameras of the sensor, for the visibility.
    deviations (g,)                 True minus nominal geometric numbers.
    joints, start (N, n) and (N, 6)
                                    Joint coordinates, and the corresponding poses of the nominal
                                    robot.
    seed                            Seed of the experiment.

    Returns the readings at the measured poses, and the number of lost frames. Raises
    EstimationError, which names the pose, if the true robot cannot reach one.
    """
    taught = sensor.taught
    encoders = encoders_of(robot, settings)
    frames = settings.frames_per_pose
    rng = np.random.default_rng(child(seed, ENCODERS))
    stopped = joints + REST * robot.travel_limit * rng.uniform(-1, 1, joints.shape)
    true = true_poses(robot, deviations, stopped, start)
    if settings.measurement == "images":
        found = measured(sensor, robot, true, frames, seed, progress)
    else:
        noise = np.random.default_rng(child(seed, STATIC_NOISE))
        found = drawn(sensor, sight, true, frames, noise, progress)
    read = encoders.read(stopped, frames, rng)
    known = FrameKnowledge(taught.base_covariance, taught.platform_covariance)
    std = np.full(robot.layout.joints, encoders.mean_std(frames))
    kept = found.seen
    data = StaticPoses(
        read[kept],
        std,
        found.poses[kept],
        found.covariances[kept],
        known if settings.frames == "taught" else FrameKnowledge.none(),
        camera_errors(sensor, found.poses[kept]),
    )
    return data, found.lost
