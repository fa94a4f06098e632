"""The synthetic sensor: true scene and cameras on one side, estimator and tracker on the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from cmmsim.allowed_plugins import is_own, require_renderer
from cmmsim.checks import checked_seed, finite_array, require_kind
from cmmsim.detection.detector import find_detector
from cmmsim.errors import CmmError, UnknownOptionError
from cmmsim.files.rig_and_bodies import marked_body, require_corner
from cmmsim.files.schema import SensorFile, Timing
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array, checked_pose
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.imaging.stereo_camera import Quality, VirtualStereoCamera
from cmmsim.many_frames import Frames, measure_frames, measure_without_images, pose_rows
from cmmsim.measuring.measured_poses import MeasuredPoses
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.observation import DetectionSettings, Observer
from cmmsim.measuring.pose_estimator import METHODS, PoseEstimator
from cmmsim.measuring.taught import Taught, require_taught_for, setup_of
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages
from cmmsim.sticker_view import StickerView
from cmmsim.teaching import Progress, Teacher, exactly_taught
from cmmsim.tracker import Tracker
from cmmsim.true_cameras import TrueCameras
from cmmsim.uncertainty.common_errors import CommonErrors, MeasuringGeometry
from cmmsim.uncertainty.drift_watch import CHANCE, DriftWatch
from cmmsim.uncertainty.known_rig import KnownRig
from cmmsim.without_images.drawn_stickers import STATISTICAL, DrawnStickers, StatisticalStereoCamera

if TYPE_CHECKING:
    from cmmsim.without_images.statistical_tracker import StatisticalTracker

TEACHING_STREAM = 0
RUN_STREAM = 1
DROPOUT_STREAM = 2


class Sensor:
    """A stereo optical CMM that looks at a posed platform.

    The cameras that draw are the file's; those that measure are the file's, too, or as they are
    ``known``, or were when the sensor was ``taught``.

    It teaches itself on first use, or takes what a sensor with the same cameras, planes and
    stickers was taught; raises TeachingError, naming what differs, for what another one was taught.
    """

    def __init__(
        self,
        file: SensorFile,
        seed: int = 0,
        method: str = "registration",
        taught: Taught | None = None,
        progress: Progress | None = None,
        renderer: str | None = None,
        known: KnownRig | None = None,
    ) -> None:
        require_kind(
            file, SensorFile, "a sensor is made of a SensorFile; load_sensor takes a name or a path"
        )
        if method not in METHODS:
            raise UnknownOptionError("method", method, METHODS)
        find_detector(file.detection.detector)
        self._asked_renderer = require_renderer(file.renderer if renderer is None else renderer)
        if is_own(self._asked_renderer):
            choose_renderer(self._asked_renderer)
        if progress is not None and not callable(progress):
            raise CmmError(
                f"progress must be a function of the steps done and their number, got {progress!r}"
            )
        self._file = file
        self._seed = checked_seed(seed)
        self._progress = progress
        self.method = method
        self._known = taught.known if isinstance(taught, Taught) else known
        figures = file.camera.model_dump(exclude={"pattern_seed"})
        self.noise = CameraNoise(
            **{("enabled" if k == "noise" else k): v for k, v in figures.items()}
        )
        self.optics = Optics(**file.lens.model_dump())
        self.platform = marked_body("platform", file.platform)
        self.base = marked_body("base", file.base)
        if taught is not None:
            require_kind(taught, Taught, "taught must be what another sensor's teach() returned")
            require_taught_for(taught, file, len(self.platform.nominal))
        bodies = self.platform, self.base
        self.true_cameras = TrueCameras(file, bodies, self.noise, self.optics, self._asked_renderer)
        self.rig = self.true_cameras.rig if self._known is None else self._known.rig
        self._taught = taught
        self._tracker: Tracker | StatisticalTracker | None = None
        self._watch: DriftWatch | None = None
        self.start_run(seed)

    def __repr__(self) -> str:
        state = "not yet taught" if self._taught is None else "taught"
        how = f"method {self.method!r}, renderer {self._asked_renderer!r}"
        return f"Sensor({self.name!r}, {how}, {state})"

    @property
    def name(self) -> str:
        """Name of the sensor file."""
        return self._file.name

    @property
    def renderer(self) -> str:
        """Name of the renderer that draws; "auto" is decided on first use."""
        return self.true_cameras.renderer.name

    @cached_property
    def _view(self) -> StickerView:
        """The stickers as the known rig should see them."""
        place = self.true_cameras.camera_from_base
        return StickerView(
            self._file, self.platform, self.base, self.rig, self._known, place, self.optics
        )

    @cached_property
    def settings(self) -> DetectionSettings:
        """Settings of the search for stickers in windows."""
        return self._view.settings(self.noise, self.camera.centre_error_px(Quality()))

    @property
    def timing(self) -> Timing:
        """Frame rate, exposure, latency with its jitter, and dropout, as the file states them."""
        return self._file.timing

    @property
    def note(self) -> str:
        """Warning about the file's figures, as that they are assumed; else empty."""
        return self._file.note

    @property
    def home(self) -> Array:
        """Pose (6,) of the platform at teaching."""
        return np.array(self._file.platform.home)

    @property
    def taught(self) -> Taught:
        """Result of teaching; teaches on first use."""
        return self.teach()

    @property
    def truth(self) -> Taught:
        """True places of rig and stickers, for studies of the observation noise alone.

        No part of the chain knows of them.
        """
        return exactly_taught(self._file)

    @property
    def estimator(self) -> PoseEstimator:
        """The part that turns images into poses, also those from elsewhere."""
        common = None
        if self._known is not None:
            known = self._known.covariance
            common = partial(
                self._geometry.pose_covariance, rig_covariance=known, method=self.method
            )
        return PoseEstimator(
            self.rig, self.noise, self.settings, self.platform, self.taught, self.method, common
        )

    @cached_property
    def _geometry(self) -> MeasuringGeometry:
        """The set-up as it is known once it is taught."""
        return MeasuringGeometry(self.rig, self.platform, self.base, self.taught, self.home)

    @property
    def observer(self) -> Observer:
        """The part that finds stickers in images, which needs no teaching."""
        return Observer(self.rig, self.noise, self.settings)

    def teach(self, progress: Progress | None = None) -> Taught:
        """Teach the frames of base and platform, unless that has been done.

        ``progress(done, total)`` is called.
        """
        if self._taught is None:
            for body in (self.platform, self.base):
                require_corner(body)
            teacher = Teacher(
                self.camera, self.observer, self.platform, self.base, self._view.sizes.plan()
            )
            rng = np.random.default_rng([self._seed, TEACHING_STREAM])
            found = teacher.teach(self.name, self.home, rng, progress or self._progress)
            self._taught = replace(found, setup=setup_of(self._file), known=self._known)
        return self._taught

    def start_run(self, seed: int) -> None:
        """Begin a new run: new noise, and the next measurement searches the whole images.

        Every frame has a noise stream of its own, so that a dropped one changes nothing in the
        others. Raises CmmError for a seed that is no whole number from 0 on.
        """
        self._run_seed = checked_seed(seed)
        self._frame = 0
        self._dropout_rng = np.random.default_rng([seed, DROPOUT_STREAM])
        if self._tracker is not None:
            self._tracker.forget()
        if self._watch is not None:
            self._watch.restart()

    def add_bodies(self, meshes: Mapping[str, trimesh.Trimesh]) -> None:
        """Register further rigid bodies, meshes in m, that may hide stickers.

        They are drawn where ``obstacles`` says. Raises CmmError for anything but meshes by name.
        """
        self.true_cameras.add_bodies(meshes)

    def move_rig(self, changes: Mapping[str, float], right_later: float = 0.0) -> None:
        """Change the true rig by named amounts, as ``{"right.cx_px": 0.1}``, and have the right
        camera expose later, s; the estimator is not told.

        Raises CmmError for a name that a rig has not (``stereo_rig.PARAMETER_NAMES``), ShapeError
        for a number that is not finite.
        """
        self.true_cameras.move(changes, right_later)

    def drift_rig(self, changes: Mapping[str, float], frames: int) -> None:
        """Have the true rig change by named amounts, as ``{"right.cx_px": 0.1}``, evenly from the
        first to the last of so many frames of each run from now on; the estimator is not told. No
        changes: no drift.

        Raises CmmError for a name that a rig has not, fewer than two frames, or where the stickers
        leave an image; ShapeError for a number that is not finite.
        """
        self.true_cameras.drift(changes, frames)

    def common_errors(self, poses: ArrayLike, rates: ArrayLike) -> CommonErrors:
        """Errors of rig and taught frames, and how they move poses (N, 6) at rates (N, 6).

        Raises CmmError for the method "planes", ShapeError for anything but rows of six finite
        numbers.
        """
        self._require_registration("common errors are known of")
        known = self._known or KnownRig(self.rig, np.zeros((len(PARAMETER_NAMES),) * 2))
        at = np.asarray(poses, dtype=float)
        along = np.asarray(rates, dtype=float)
        return self._geometry.common_errors(at, along, known.covariance, known.exposure_std)

    def look(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> StereoImages | DrawnStickers:
        """One exposure, drawn as far as it is read.

        Parameters: pose (6,) of the platform in the middle of the exposure; obstacles: name ->
        base_from_body (4,4), they stand still; pose_rate (6,), m/s and rad/s: the time derivative
        of the pose, which blurs the image when the sensor's exposure is not zero. Raises
        ShapeError, UnknownBodyError, and CmmError for too long a blur or for obstacles that are no
        transforms by name.
        """
        checked = checked_pose(pose)
        placed = self.true_cameras.placed(obstacles)
        if pose_rate is not None:
            wanted = "a pose rate is six finite numbers, m/s and rad/s"
            pose_rate = finite_array(pose_rate, (6,), wanted)
        rng = np.random.default_rng([self._run_seed, RUN_STREAM, self._frame])
        camera = self.true_cameras.at(self._frame)
        self._frame += 1
        return camera.look(checked, rng, placed, pose_rate=pose_rate)

    def capture(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> StereoFrame:
        """Both whole images; parameters as in ``look``."""
        return self.look(pose, obstacles, pose_rate).full()

    def measure(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> Measurement:
        """Measure the platform; parameters as in ``look``, they go to the renderer only.

        The measured pose is that in the middle of the exposure. A frame that drops out is lost
        without being looked at.
        """
        images = self.look(pose, obstacles, pose_rate)
        if self._tracker is None:
            self._tracker = self._new_tracker()
        if self._dropout_rng.random() < self.timing.dropout:
            self._tracker.miss()
            share = f"a share of {self.timing.dropout:.3g} drops out"
            measured = lost_measurement(f"dropped frame ({share})")
        else:
            measured = self._tracker.measure(images)
        if self._watch is not None:
            self._watch.look(measured, images, self.observer)
        return measured

    def watch_drift(self, base: bool = False, chance: float = CHANCE) -> DriftWatch:
        """Watch from now on whether the rig still is as it was taught, in each run for itself.

        base: look at the base's stickers as well, which takes twice the time and sees smaller
        movements, and those of the whole rig; chance of a false alarm in a run. Raises CmmError for
        the method "planes", and for a chance that is none.
        """
        self._require_registration("drift is told from")
        offset = float(np.hypot(self.settings.centre_error_px, self.observer.detector.bias_px))
        period = 1.0 / self.timing.frame_rate
        self._watch = DriftWatch(self._geometry, self._known, period, chance, offset, base)
        return self._watch

    def _require_registration(self, what: str) -> None:
        if self.method != "registration":
            raise CmmError(f"{what} poses by registration only, not by {self.method}")

    def measure_many(
        self,
        poses: ArrayLike,
        pose_rates: ArrayLike | None = None,
        obstacles: Mapping[str, Array] | None = None,
        near: ArrayLike | None = None,
    ) -> MeasuredPoses:
        """Measure the platform at poses (N,6) in motion at pose_rates (N,6), one frame each.

        Obstacles stand still. Each frame has noise and dropout of its own, and the rig does not
        drift. The noise is as large as that of ``measure``, its numbers are others. Stickers are
        looked for near poses (N,6), or where they are. Frames are drawn and measured on all cores.
        Raises ShapeError for anything but such rows.
        """
        at = pose_rows(poses)
        wanted = "there is a pose rate to each pose, six finite numbers, m/s and rad/s"
        rates = finite_array(0.0 * at if pose_rates is None else pose_rates, at.shape, wanted)
        around = finite_array(
            at if near is None else near, at.shape, "there is a pose near each pose, finite"
        )
        camera = self.camera
        placed = self.true_cameras.placed(obstacles)
        if isinstance(camera, VirtualStereoCamera):
            blocks = measure_frames(camera, *self._frames(at, rates, around, placed))
            found = MeasuredPoses.of([each.found for each in blocks])
        elif isinstance(tracker := self._new_tracker(), Tracker):
            found = MeasuredPoses.of_each(
                measure_without_images(camera, *self._frames(at, rates, around, placed))
            )
        else:
            rng = np.random.default_rng([self._run_seed, RUN_STREAM, self._frame])
            self._frame += len(at)
            found = tracker.measure_many(
                camera, camera.exposed(at, rates), camera.placed(placed), rng
            )
        return found.without(self._dropout_rng.random(len(at)) < self.timing.dropout)

    def measure_each(self, poses: ArrayLike, near: ArrayLike) -> list[Measurement]:
        """Measure a platform at rest at poses (N,6), near others; no frame drops out.

        Without images, stickers are looked for in windows near poses (N,6), too.
        """
        at = pose_rows(poses)
        camera = self.camera
        around = finite_array(near, at.shape, "there is a pose near each pose, finite")
        frames = self._frames(at, 0.0 * at, around, {})
        if isinstance(camera, StatisticalStereoCamera):
            return measure_without_images(camera, *frames)
        return [one for each in measure_frames(camera, *frames) for one in each.measurements()]

    def _frames(
        self, at: Array, rates: Array, around: Array, placed: Mapping[str, Array]
    ) -> Frames:
        """The next frames, at poses ``at`` and rates, looked for ``around``, all (N,6)."""
        first = self._frame
        self._frame += len(at)
        streams = range(first, first + len(at))
        rngs = [np.random.default_rng([self._run_seed, RUN_STREAM, k]) for k in streams]
        return self.estimator, at, rates, around, rngs, placed

    def _new_tracker(self) -> Tracker | StatisticalTracker:
        """A tracker, which measures frame after frame."""
        if self.renderer != STATISTICAL.name or self.method != "registration":
            return Tracker(self.estimator)
        # Late, as numba takes time to import.
        from cmmsim.without_images.statistical_tracker import StatisticalTracker

        return StatisticalTracker(self.estimator)

    @property
    def camera(self) -> VirtualStereoCamera | StatisticalStereoCamera:
        """The two cameras before the true scene, as they are at teaching."""
        return self.true_cameras.at_rest
