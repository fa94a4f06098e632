"""Instrument: the part of a sensor that is the same in all runs.

An instrument consists of the true cameras and scene, the camera parameters that the estimator
knows, and the result of teaching.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from cmmsim.allowed_plugins import is_plugin_name, require_renderer
from cmmsim.checks import checked_seed, require_kind
from cmmsim.detection.detector import find_detector
from cmmsim.errors import CmmError, UnknownOptionError
from cmmsim.files.rig_and_bodies import lens_from_file, marked_body, require_corner
from cmmsim.files.schema import SensorFile, Timing
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.imaging.stereo_camera import Quality, VirtualStereoCamera
from cmmsim.measuring.observation import DetectionSettings, Observer
from cmmsim.measuring.pose_estimator import METHODS, PoseEstimator
from cmmsim.measuring.taught import Taught, require_taught_for, setup_of
from cmmsim.photographs.pairs import Photograph, numbered
from cmmsim.photographs.photographed_teaching import PhotographedTeaching, teach_from
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages
from cmmsim.sticker_view import StickerView
from cmmsim.teaching import (
    Progress,
    Teacher,
    exactly_taught,
)
from cmmsim.true_cameras import TrueCameras
from cmmsim.uncertainty.common_errors import CommonErrors, MeasuringGeometry
from cmmsim.uncertainty.known_rig import KnownRig
from cmmsim.uncertainty.print_errors import known_errors
from cmmsim.without_images.drawn_stickers import StatisticalStereoCamera

TEACHING_STREAM = 0  # separates the random numbers of teaching from those of runs


class Instrument:
    """The part of a `Sensor` that does not change from run to run."""

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
            file, SensorFile, "Sensor takes a SensorFile; load_sensor takes a name or a path"
        )
        if method not in METHODS:
            raise UnknownOptionError("method", method, METHODS)
        find_detector(file.detection.detector)
        self._renderer_name = require_renderer(file.renderer if renderer is None else renderer)
        # A user's own renderer is imported now, so that an exception is reported before work
        # begins.
        if is_plugin_name(self._renderer_name):
            choose_renderer(self._renderer_name)
        if progress is not None and not callable(progress):
            raise CmmError(
                "progress must be a function of the number of steps done and their total, got "
                f"{progress!r}"
            )
        self._file = file
        self._seed = checked_seed(seed)
        self._progress = progress
        self.method = method
        self._known = taught.known if isinstance(taught, Taught) else known
        values = file.camera.model_dump(exclude={"pattern_seed", "grey_noise_percent"})
        self.noise = CameraNoise(
            **{("enabled" if k == "noise" else k): v for k, v in values.items()}
        )
        lens = lens_from_file(file)
        # An estimator that does not know the lens assumes that all depths are in focus, and that
        # there is no ghost.
        blur = Optics(lens.psf_px, lens.vignetting)
        self.optics = lens if file.lens.known else blur
        self.platform = marked_body("platform", file.platform)
        self.base = marked_body("base", file.base)
        if taught is not None:
            require_kind(taught, Taught, "taught must be a result of another sensor's teach()")
            require_taught_for(taught, file, len(self.platform.nominal))
        bodies = self.platform, self.base
        self.true_cameras = TrueCameras(file, bodies, self.noise, self.optics, self._renderer_name)
        self.rig = self.true_cameras.rig if self._known is None else self._known.rig
        # Teaching from photographs always begins with these values, even if it is repeated.
        self._stated = self.platform, self.rig, self._known
        self._taught: Taught | None = None
        if taught is not None:
            self._take(taught)

    def __repr__(self) -> str:
        state = "not yet taught" if self._taught is None else "taught"
        how = f"method {self.method!r}, renderer {self._renderer_name!r}"
        return f"Sensor({self.name!r}, {how}, {state})"

    @property
    def name(self) -> str:
        """Name of the sensor file."""
        return self._file.name

    @property
    def renderer(self) -> str:
        """Name of the renderer in use. "auto" is resolved on first use."""
        return self.true_cameras.renderer.name

    @cached_property
    def _view(self) -> StickerView:
        """Stickers at their expected pixels in the images of the known rig."""
        from_base = self.true_cameras.camera_from_base
        return StickerView(
            self._file, self.platform, self.base, self.rig, self._known, from_base, self.optics
        )

    @cached_property
    def settings(self) -> DetectionSettings:
        """Settings of the search for stickers in windows."""
        settings = self._view.settings(self.noise, self.camera.centre_error_px(Quality()))
        taught = self._taught
        if taught is None or taught.radius is None:
            return settings
        return replace(settings, radius=taught.radius)

    @property
    def timing(self) -> Timing:
        """Frame rate, exposure, latency with its jitter, and dropout, from the sensor file."""
        return self._file.timing

    @property
    def note(self) -> str:
        """Warning about the numbers in the sensor file, for example that they are assumed.

        The text is empty if there is no warning.
        """
        return self._file.note

    @property
    def home(self) -> Array:
        """Pose (6,) about which the platform moves at teaching, m and rad."""
        return np.array(self._file.platform.home)

    @property
    def taught(self) -> Taught:
        """Result of teaching, which takes place on first use."""
        return self.teach()

    @property
    def truth(self) -> Taught:
        """Result of a teaching without errors: the true base frame and sticker positions.

        Measurements do not use this result. It serves studies of the observation noise alone.
        """
        return exactly_taught(self._file)

    @property
    def estimator(self) -> PoseEstimator:
        """Estimator that computes poses from images, including images from other sources."""
        common = None
        if self._known is not None or self._geometry.print is not None:
            covariance = self._known_rig.covariance
            common = partial(
                self._geometry.pose_covariance, rig_covariance=covariance, method=self.method
            )
        return PoseEstimator(
            self.rig, self.noise, self.settings, self.platform, self.taught, self.method, common
        )

    @cached_property
    def _geometry(self) -> MeasuringGeometry:
        """Geometry of cameras, bodies and taught frames, as the estimator knows it."""
        bodies = self.platform, self.base
        errors = known_errors(self._file)
        return MeasuringGeometry(self.rig, *bodies, self.taught, self.home, errors)

    @property
    def _known_rig(self) -> KnownRig:
        """Known rig, with a covariance of zero if it is known exactly."""
        return self._known or KnownRig(self.rig, np.zeros((len(PARAMETER_NAMES),) * 2))

    @property
    def observer(self) -> Observer:
        """Observer that finds stickers in images. It needs no teaching."""
        return Observer(self.rig, self.noise, self.settings)

    @property
    def camera(self) -> VirtualStereoCamera | StatisticalStereoCamera:
        """Both true cameras in front of the true scene, without drift."""
        return self.true_cameras.at_rest

    def teach(
        self,
        progress: Progress | None = None,
        frames: Iterable[StereoFrame | StereoImages] | None = None,
    ) -> Taught:
        """Teach the frames of base and platform, unless they are taught already.

        Parameters
        ----------
        progress : callable, optional
            Function that is called with the number of steps done and their total.
        frames : iterable of StereoFrame or of results of `Sensor.look`, optional
            Exposures of the platform in several poses. Teaching uses them instead of exposures that
            the sensor takes itself, and replaces an earlier teaching.

        Returns
        -------
        Taught
            Result, which can be passed to other sensors with the same cameras and bodies.

        Raises
        ------
        TeachingError
            If a sticker cannot be seen, if the three planes of a body do not meet in one point, or
            if teaching from ``frames`` fails.

        Examples
        --------
        >>> sensor.teach().sensor_name
        'ctrack780'
        """
        if frames is not None:
            self._take(self.teach_from(numbered(frames, self.timing.frame_rate)).taught)
        if self._taught is None:
            for body in (self.platform, self.base):
                require_corner(body)
            teacher = Teacher(
                self.camera, self.observer, self.platform, self.base, self._view.teaching_plan()
            )
            rng = np.random.default_rng([self._seed, TEACHING_STREAM])
            taught = teacher.teach(self.name, self.home, rng, progress or self._progress)
            self._taught = replace(taught, setup=setup_of(self._file), known=self._known)
        return self._taught

    def teach_from(
        self, photographs: Iterable[Photograph], advance: Callable[[], None] = lambda: None
    ) -> PhotographedTeaching:
        """Return the result of teaching from photographs. The sensor itself does not use it.

        Parameters
        ----------
        photographs : iterable of Photograph
            Pairs of images.
        advance : callable, optional
            Function that is called after each pair.

        Returns
        -------
        PhotographedTeaching

        Raises
        ------
        TeachingError
            If there are too few pairs, or if the stickers do not determine the frames.
        """
        platform, rig, known = self._stated
        for body in (platform, self.base):
            require_corner(body)
        observer = replace(self.observer, rig=rig)
        result = teach_from(photographs, observer, platform, self.base, self.name, known, advance)
        return replace(result, taught=replace(result.taught, setup=setup_of(self._file)))

    def _take(self, taught: Taught) -> None:
        """Use a result of teaching, with its rig and its stickers, from now on."""
        self._taught = taught
        if taught.known is not None:
            self._known = taught.known
            self.rig = taught.known.rig
        if taught.platform_ids:
            whole = self._stated[0]
            kept = np.isin(whole.sticker_ids, taught.platform_ids)
            self.platform = whole.selected(np.flatnonzero(kept))
        for name in ("_view", "settings", "_geometry"):
            self.__dict__.pop(name, None)

    def add_bodies(self, meshes: Mapping[str, trimesh.Trimesh]) -> None:
        """Register further rigid bodies, which can hide stickers.

        The argument ``obstacles`` of `Sensor.look` places them in an exposure.

        Parameters
        ----------
        meshes : mapping of str to trimesh.Trimesh
            Bodies by name, in m.

        Raises
        ------
        CmmError
            If ``meshes`` is not a mapping of names to meshes.

        Examples
        --------
        >>> import cmmsim
        >>> sensor.add_bodies({"leg": cmmsim.rod(0.3, 0.01)})
        """
        self.true_cameras.add_bodies(meshes)

    def move_rig(self, changes: Mapping[str, float], right_later: float = 0.0) -> None:
        """Add changes to the true rig. The estimator's known rig does not change.

        Parameters
        ----------
        changes : mapping of str to float
            Amounts by parameter name, as ``{"right.cx_px": 0.1}``. The names are listed in
            ``stereo_rig.PARAMETER_NAMES``.
        right_later : float
            Delay of the right camera's exposure after the left camera's exposure, s. It replaces
            the delay of an earlier call.

        Raises
        ------
        CmmError
            If a name is not a parameter of the rig.
        ShapeError
            If an amount or the delay is not a finite number.

        Examples
        --------
        >>> sensor.move_rig({"right.cx_px": 0.1})
        >>> sensor.move_rig({"right.cx_px": -0.1})
        """
        self.true_cameras.move(changes, right_later)

    def drift_rig(self, changes: Mapping[str, float], frames: int) -> None:
        """Let the true rig drift linearly with time in each run from now on.

        The estimator's known rig does not change.

        Parameters
        ----------
        changes : mapping of str to float
            Amounts by name, as in `move_rig`. An empty mapping ends the drift.
        frames : int
            Number of frames of the drift. The last one and all later frames have the full amounts.

        Raises
        ------
        CmmError
            If a name is not a parameter of the rig, there are fewer than two frames, or the drift
            moves stickers out of an image.
        ShapeError
            If an amount is not a finite number.

        Examples
        --------
        >>> sensor.drift_rig({"right.cx_px": 0.1}, frames=100)
        >>> sensor.drift_rig({}, frames=100)
        """
        self.true_cameras.drift(changes, frames)

    def common_errors(self, poses: ArrayLike, rates: ArrayLike) -> CommonErrors:
        """Return the errors of the rig and of the taught frames, which all poses have in common.

        Parameters
        ----------
        poses, rates : array_like, shape (N, 6)
            Poses in m and rad, and their time derivatives.

        Returns
        -------
        CommonErrors
            The errors, and the changes of the poses that the errors cause.

        Raises
        ------
        CmmError
            If the method is "planes".
        ShapeError
            If a row of poses or rates is not six finite numbers.

        Examples
        --------
        >>> poses = np.array([sensor.home])
        >>> sensor.common_errors(poses, 0.0 * poses).changes.shape[:2]
        (1, 6)
        """
        self._require_registration("common errors can be computed for")
        known = self._known_rig
        rows = np.asarray(poses, dtype=float)
        changes = np.asarray(rates, dtype=float)
        return self._geometry.common_errors(rows, changes, known.covariance, known.exposure_std)

    def _require_registration(self, what: str) -> None:
        """Raise CmmError unless the method is "registration"; ``what`` begins the message."""
        if self.method != "registration":
            raise CmmError(f"{what} poses by registration only, not by {self.method}")
