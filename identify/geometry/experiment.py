"""The simulated calibration: a robot whose geometry is off stands at poses, encoders and the
optical CMM read it.

Its joints go where they are told, in the coordinates of its encoders; so the platform stands where
the true geometry puts it, and an encoder's offset is part of that geometry. Poses are measured
through images, or drawn with the noise that the sensor states for one image.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import cmmsim
from cmmsim.errors import LostError
from cmmsim.visibility import SightLines, sight_lines, stated_covariance
from dynamics import Robot
from dynamics.closure import Closure
from dynamics.errors import ConvergenceError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.experiment.sensor_in_loop import robot_transforms
from identify.geometry.calibration import seen_between
from identify.geometry.static_poses import FrameKnowledge, StaticPoses
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import ENCODERS, NOISE, STATIC_NOISE, child, stream_seed
from identify.record.common_errors import CommonErrors, kind_of
from identify.scenario import Scenario
from identify.scenario.sections import Geometry

FIRST_POSE_RUN = 2_000_000
"""Number of the sensor's run at the first pose, beyond those of all motions."""


REST = 1e-3
"""Share of the travel by which friction keeps joints from where they are sent; encoders say where
that is.
"""


@dataclass(frozen=True)
class Encoders:
    """Encoders of a robot's joints: noise of one reading, step, and standard deviation of offsets,
    rad or m.
    """

    noise: float
    resolution: float
    offset: float

    def mean_std(self, readings: int) -> float:
        """Standard deviation of the mean of readings of a joint that stands still.

        The step's error is that of a sawtooth, and noise smooths it: of its k-th wave, 1 / (pi k)
        steps high, readings with noise of s steps keep exp(-2 (pi k s)^2) in their mean.
        """
        if not self.resolution:
            return self.noise / readings**0.5
        waves = np.pi * np.arange(1, 30)
        steps = self.noise / self.resolution
        kept = self.resolution**2 * np.sum(np.exp(-4 * (waves * steps) ** 2) / waves**2) / 2
        return float(np.sqrt(kept + (self.noise**2 + self.resolution**2 / 12 - kept) / readings))

    def read(self, joints: Array, readings: int, rng: np.random.Generator) -> Array:
        """Means (N, n) of readings of joint coordinates (N, n)."""
        each = joints + self.noise * rng.standard_normal((readings, *joints.shape))
        step = self.resolution
        return np.asarray((step * np.round(each / step) if step else each).mean(axis=0))


def encoders_of(robot: Robot, settings: Geometry) -> Encoders:
    """The encoders of a scenario's calibration, for a robot whose actuators turn or slide."""
    return Encoders(
        *(
            of_actuators(robot, settings, f"encoder_{name}")
            for name in ("noise", "resolution", "offset")
        )
    )


def true_poses(robot: Robot, deviations: Array, joints: Array, start: Array) -> Array:
    """Where the true robot stands (N, 6) when its encoders show joints (N, n).

    Raises EstimationError, naming the pose, for one that it cannot reach.
    """
    try:
        return Closure(robot.geometry).poses(joints, deviations, start)
    except ConvergenceError as error:
        raise EstimationError(f"the true robot does not reach a pose: {error}") from error


@dataclass(frozen=True)
class Sighted:
    """Means of frames at poses (N, 6), their covariances (N, 6, 6), which poses were seen (N,), and
    lost frames.
    """

    poses: Array
    covariances: Array
    seen: NDArray[np.bool_]
    lost: int


def measured(
    sensor: cmmsim.Sensor, robot: Robot, poses: Array, frames: int, seed: int, progress: Progress
) -> Sighted:
    """Poses measured through images.

    The share of the stated variance that frames at rest do not scatter by, such as the errors of
    drawing and of detection, does not average: it stays whole in the covariance of a mean.
    """
    means = np.full_like(poses, np.nan)
    stated = np.full((len(poses), 6, 6), np.nan)
    scatter = 0.0
    spare = 0
    counts = np.zeros(len(poses), dtype=int)
    with progress.stage("measure poses", len(poses) * frames) as advance:
        for row, pose in enumerate(poses):
            bodies = robot_transforms(robot, pose)
            sensor.start_run(stream_seed(seed, NOISE, FIRST_POSE_RUN + row))
            values, covariances = _frames_at(sensor, pose, bodies, frames)
            advance(frames)
            if len(values):
                means[row] = values.mean(axis=0)
                counts[row] = len(values)
                stated[row] = covariances.mean(axis=0)
                away = values - means[row]
                scatter += (
                    float(np.sum(away * np.linalg.solve(stated[row], away.T).T)) / away.shape[1]
                )
                spare += len(values) - 1
    seen = counts > 0
    share = min(scatter / spare, 1.0) if spare else 0.0
    kept = 1 - share * (1 - 1 / np.maximum(counts, 1))
    return Sighted(
        means, stated * kept[:, None, None], seen, int(len(poses) * frames - counts.sum())
    )


def _frames_at(
    sensor: cmmsim.Sensor, pose: Array, bodies: Mapping[str, Array], frames: int
) -> tuple[Array, Array]:
    """Poses (k, 6) and covariances (k, 6, 6) of the frames at a pose that gave one: images are
    searched as a whole until they give one, in all others stickers are looked for near that."""
    left = frames
    while left:
        first = sensor.measure(pose, bodies)
        left = left - 1
        if not first.ok:
            continue
        rest = sensor.measure_many(
            np.tile(pose, (left, 1)), obstacles=bodies, near=np.tile(first.pose, (left, 1))
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
) -> Sighted:
    """Poses without images: one frame a pose says the covariance, and the mean is drawn with a
    `frames`-th of it; and so are one error of the frames with what teaching says of them, and one
    of the cameras where they are not exact."""
    taught = sensor.taught
    offset = FrameKnowledge(
        taught.base_covariance, taught.platform_covariance
    ).root @ rng.standard_normal(12)
    covariances = np.full((len(poses), 6, 6), np.nan)
    seen = np.zeros(len(poses), dtype=bool)
    with progress.stage("draw poses", len(poses)) as advance:
        for row, pose in enumerate(poses):
            with suppress(LostError):
                covariances[row] = stated_covariance(sensor, sight, pose) / frames
                seen[row] = True
            advance()
    means = seen_between(poses, offset)
    if (by_cameras := camera_errors(sensor, poses)) is not None:
        means = means + by_cameras @ rng.standard_normal(by_cameras.shape[2])
    for row in map(int, np.flatnonzero(seen)):
        means[row] += np.linalg.cholesky(covariances[row]) @ rng.standard_normal(6)
    return Sighted(means, covariances, seen, int((~seen).sum()) * frames)


def camera_errors(sensor: cmmsim.Sensor, poses: Array) -> Array | None:
    """What cameras that are known only so well add to poses (N, 6) at rest: (N, 6, k) for each of k
    independent errors of variance one, the same for all poses; None where they are exact."""
    found = (
        sensor.common_errors(poses, np.zeros_like(poses))
        if sensor.method == "registration"
        else None
    )
    if found is None or not (
        kept := [k for k, name in enumerate(found.names) if kind_of(name) == "rig"]
    ):
        return None
    within = found.covariance[np.ix_(kept, kept)]
    return CommonErrors(
        tuple(found.names[k] for k in kept), found.changes[:, :, kept], within
    ).modes


def stand_at(
    robot: Robot,
    scenario: Scenario,
    sensor: cmmsim.Sensor,
    deviations: Array,
    joints: Array,
    start: Array,
    seed: int,
    progress: Progress,
) -> tuple[StaticPoses, int]:
    """What encoders and sensor say where the true robot stops that is sent to joint coordinates (N,
    n), near poses `start` (N, 6) of the nominal one; and the number of frames that were lost. Poses
    without any are left out.

    Raises EstimationError, naming the pose, for one that the true robot cannot reach.
    """
    settings = scenario.geometry
    taught = sensor.taught
    encoders = encoders_of(robot, settings)
    frames = settings.frames_per_pose
    rng = np.random.default_rng(child(seed, ENCODERS))
    stopped = joints + REST * robot.travel_limit * rng.uniform(-1, 1, joints.shape)
    true = true_poses(robot, deviations, stopped, start)
    if settings.measurement == "images":
        found = measured(sensor, robot, true, frames, seed, progress)
    else:
        sight = sight_lines(scenario.sensor, scenario.sensor_changes)
        found = drawn(
            sensor, sight, true, frames, np.random.default_rng(child(seed, STATIC_NOISE)), progress
        )
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
