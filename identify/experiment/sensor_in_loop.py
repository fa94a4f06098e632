"""Rendering stereo sensor as the pose sensor of the closed loop, with a log of its measurements."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

import cmmsim
from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import marked_body, rig_from_file
from cmmsim.files.schema import unit
from cmmsim.geometry.pose import pose_to_transform
from cmmsim.uncertainty.known_rig import KnownRig
from cmmsim.visibility import SightLines, drawing_sensor, stated_covariance
from dynamics import Robot
from dynamics.bodies import parts_of
from dynamics.closed_loop import IdealSensor, RateSensor
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.leg_bodies import robot_meshes, robot_transforms
from identify.experiment.rig_as_known import known_rig
from identify.progress import Advance, Progress
from identify.random_streams import CALIBRATION, TEACHING, stream_seed
from identify.scenario.sections import Rig

# Largest allowed distance, m, of a leg's end outside the sensor file's platform, and between the
# homes of this platform and of the robot.
OFF_PLATFORM_M = 0.05
# Next step if the platform of the sensor is not that of the robot.
OWN_SENSOR = (
    "cmmsim new sensor FILE --robot ROBOT writes one that fits; --set sensor=FILE names it, in "
    'Python load_scenario(..., sensor="FILE")'
)


@dataclass(frozen=True)
class SensorPlan:
    """Description of the sensor of an experiment.

    name      Name in messages.
    file      Sensor file, with the changes and the timing of the experiment.
    renderer  Renderer of the images.
    method    Method of the pose measurement.
    rig       Knowledge, errors and drift of the cameras, and the drift watch.
    frames    Default number of frames over which the cameras drift.
    """

    name: str
    file: SensorFile
    renderer: str
    method: str
    rig: Rig
    frames: int

    @property
    def sight(self) -> SightLines:
        """Stickers and cameras, which determine the stickers that are visible."""
        return sight_lines(self.file)

    def covariance(self, pose: Array) -> Array:
        """Return the covariance (6, 6) [m, rad] that the sensor states for a pose (6,) at rest."""
        return _covariance(self.file.model_dump_json(), self.method, tuple(pose)).copy()

    def make(
        self,
        robot: Robot,
        seed: int,
        taught: cmmsim.Taught | None = None,
        known: KnownRig | None = None,
    ) -> cmmsim.Sensor:
        """Make the sensor, with its rig errors and the legs of a robot in view.

        robot   Robot whose legs are in view.
        seed    Seed of the sensor.
        taught  Frames that were taught before.
        known   Rig as the estimator knows it. The default is exact knowledge, or the rig of
                `taught`.

        Raises ScenarioError if the platform in the sensor file is not the robot's platform.
        """
        check_platform(robot, self.file, self.name)
        sensor = cmmsim.Sensor(
            self.file, seed, self.method, taught, renderer=self.renderer, known=known
        )
        # These calls move only the true cameras, and not the cameras that the estimator knows.
        sensor.move_rig(self.rig.errors, self.rig.right_later_s or 0.0)
        sensor.drift_rig(self.rig.drift, self.frames)
        sensor.add_bodies(robot_meshes(robot))
        return sensor

    def untaught(self, robot: Robot, seed: int, progress: Progress | None = None) -> cmmsim.Sensor:
        """Make the sensor of a run, before teaching.

        The noise of the teaching and the error of the known rig depend on the seed of the run.
        Raises the errors of `make` and `known_rig`.
        """
        rng = np.random.default_rng(stream_seed(seed, CALIBRATION))
        known = known_rig(self.rig, self.file, rng, progress)
        return self.make(robot, stream_seed(seed, TEACHING), known=known)

    def taught(self, robot: Robot, seed: int, progress: Progress) -> cmmsim.Sensor:
        """Make the sensor of a run, and teach it its frames."""
        sensor = self.untaught(robot, seed, progress)
        teach(sensor, progress)
        return sensor


def teach(sensor: cmmsim.Sensor, progress: Progress) -> None:
    """Teach the frames of a sensor, and report the progress in per cent."""
    with progress.stage("teach the sensor", 100) as advance:
        shown = 0

        def report(done: int, total: int) -> None:
            nonlocal shown
            advance(100 * done // total - shown)
            shown = 100 * done // total

        sensor.teach(report)


def platform_distances(robot: Robot, file: SensorFile) -> tuple[Array, float]:
    """Return how far (n,) [m] the legs' ends lie outside the platform of a sensor file.

    Ends inside have negative values. The second value is the distance [m] between the home of this
    platform and the robot's home.
    """
    normals, reach = _half_spaces(file)
    outside = (robot.geometry.platform_joints @ normals.T - reach).max(axis=1)
    return outside, float(np.linalg.norm(robot.home_pose[:3] - np.array(file.platform.home[:3])))


def lengths_inside(robot: Robot, file: SensorFile) -> tuple[Array, tuple[int, ...]]:
    """Return the lengths (n,) [m] of the legs' rods inside the platform of a sensor file, at home.

    The second value has the index of the leg of each rod.
    """
    normals, reach = _half_spaces(file)
    parts = parts_of(robot.geometry)
    base_from_platform = pose_to_transform(robot.home_pose)
    ends = parts.rods(robot, robot.home_pose) - base_from_platform[:3, 3]
    # Depths (rods, 2, planes) of both ends below the planes, m.
    depths = reach - ends @ base_from_platform[:3, :3] @ normals.T
    slopes = depths[:, 1] - depths[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = -depths[:, 0] / slopes
    # Each plane leaves the part of the rod, from 0 to 1, that is on its inner side.
    enters = np.where(slopes > 0, crossings, np.where((slopes == 0) & (depths[:, 0] < 0), 1.0, 0.0))
    leaves = np.where(slopes < 0, crossings, 1.0)
    shares = leaves.min(axis=1, initial=1.0) - enters.max(axis=1, initial=0.0)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return np.maximum(shares, 0.0) * lengths, tuple(part.leg for part in parts.all)


def _half_spaces(file: SensorFile) -> tuple[Array, Array]:
    """Return normals (n, 3) and offsets (n,) [m] of all sides of the platform of a sensor file."""
    body = marked_body("platform", file.platform)
    cuts = file.platform.cuts
    normals = np.vstack([body.normals, *[unit(cut.normal) for cut in cuts]])
    return normals, np.append(body.offsets, [unit(cut.normal) @ cut.point for cut in cuts])


def check_platform(robot: Robot, file: SensorFile, sensor: str) -> None:
    """Raise ScenarioError if the platform of a sensor file is not the robot's platform.

    The platforms differ if a leg ends too far outside the platform, or if the homes differ. The
    message names leg and distance.
    """
    outside, away = platform_distances(robot, file)
    leg = int(np.argmax(outside))
    if outside[leg] > OFF_PLATFORM_M:
        raise ScenarioError(
            f"platform joint {leg + 1} of {robot.name} is {outside[leg]:.3g} m outside of the "
            f"platform that sensor {sensor} sees, limit {OFF_PLATFORM_M:g} m: [platform] of the "
            f"sensor must describe the platform of the robot; {OWN_SENSOR}"
        )
    if away > OFF_PLATFORM_M:
        raise ScenarioError(
            f"home of {robot.name} is {away:.3g} m from platform.home of sensor {sensor}, limit "
            f"{OFF_PLATFORM_M:g} m: platform.home must be the home of the robot; {OWN_SENSOR}"
        )


def sight_lines(file: SensorFile) -> SightLines:
    """Return the stickers of the platform and the cameras of a sensor file."""
    return SightLines(marked_body("platform", file.platform), *rig_from_file(file.rig))


@lru_cache(maxsize=16)
def _covariance(file_json: str, method: str, pose: tuple[float, ...]) -> Array:
    """Return the covariance that a sensor states for a pose. It is cached for rows of a study."""
    file = SensorFile.model_validate_json(file_json)
    return stated_covariance(drawing_sensor(file, method), sight_lines(file), np.array(pose))


class PoseSensor(Protocol):
    """Sensor in the loop: `cmmsim.Sensor`, or an object with the same methods.

    For a sensor with `sees_bodies = False`, the poses of the legs are not computed.
    """

    def start_run(self, seed: int) -> None:
        """Begin a new run with new noise."""

    def measure(
        self,
        pose: Array,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: Array | None = None,
    ) -> cmmsim.Measurement:
        """Measure the platform at a pose (6,) [m, rad] with rate pose_rate (6,).

        Obstacles are base_from_body (4, 4) by the names of the bodies.
        """
        ...


@dataclass(frozen=True)
class DrawnFrames:
    """Measurements of a sensor that does not look at the platform, drawn before the run.

    noise (N, 6)       Error of each measurement, m and rad.
    covariance (6, 6)  Covariance of one measurement.
    lost               Reason for which each frame is lost, empty for a measured frame.
    """

    noise: Array
    covariance: Array
    lost: Sequence[str]


class SensorInLoop:
    """Sensor for the closed loop, with a log.

    The log holds the covariances (6, 6) of all frames (NaN where lost), the reasons of lost frames,
    and the duration of rendering and measuring in seconds.
    """

    def __init__(
        self, sensor: PoseSensor, robot: Robot, seed: int, advance: Advance = lambda n=1: None
    ) -> None:
        self._sensor = sensor
        self._robot = robot
        self._advance = advance
        self._sees_bodies = getattr(sensor, "sees_bodies", True)
        self.covariances: list[Array] = []
        self.lost: list[str] = []
        self.seconds = 0.0
        sensor.start_run(seed)

    def over(self, times: Array) -> IdealSensor | RateSensor:
        """Return the sensor for a loop with frames at these times (N,), s.

        A sensor with a method `in_advance` draws all frames before the run. The loop then runs
        compiled, without a call at each frame, and gives the same numbers.
        """
        draw = getattr(self._sensor, "in_advance", None)
        if draw is None:
            return RateSensor(self.measure)
        frames: DrawnFrames = draw(len(times))
        for frame, (t, reason) in enumerate(zip(times, frames.lost, strict=True)):
            self.covariances.append(np.full((6, 6), np.nan) if reason else frames.covariance)
            if reason:
                self._lose(frame, t, reason)
        self._advance(len(times))
        return IdealSensor(np.array([bool(reason) for reason in frames.lost]), frames.noise)

    @property
    def common(self) -> Array:
        """Covariance (6, 6) of the teaching error that all poses near home share, 0 if untaught."""
        taught = getattr(self._sensor, "taught", None)
        return (
            np.zeros((6, 6))
            if taught is None
            else taught.calibration_covariance(self._robot.home_pose)
        )

    def measure(self, frame: int, t: float, pose: Array, rate: Array) -> Array | None:
        """Return the measured pose (6,) at a true pose and rate, or None if the platform is lost.

        The sensor uses the true pose only to make its images. The rate causes motion blur.
        """
        # Computing the poses of the legs does not count as time of the sensor.
        bodies = robot_transforms(self._robot, pose) if self._sees_bodies else None
        began = time.perf_counter()
        measured = self._sensor.measure(pose, bodies, rate)
        self.seconds += time.perf_counter() - began
        self._advance()
        self.covariances.append(measured.covariance if measured.ok else np.full((6, 6), np.nan))
        if not measured.ok:
            self._lose(frame, t, measured.reason)
            return None
        return np.asarray(measured.pose, dtype=float)

    def _lose(self, frame: int, t: float, reason: str) -> None:
        self.lost.append(f"frame {frame} (t = {t:.3f} s): {reason}")
