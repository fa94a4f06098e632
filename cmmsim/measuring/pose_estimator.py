"""Measurement of one stereo frame (paper eq. 27 and 28). The true pose is not used.

The pose in camera axes and its covariance come from ``frame_solver``, or from ``by_planes``. Both
are then transformed to the base frame. ``frame_solver`` explains all parts of the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cmmsim.checks import finite_array, require_kind
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.errors import LostError, ShapeError, UnknownOptionError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.plane_frame import frame_from_planes, frame_of_points, frames_of_points
from cmmsim.geometry.pose import Array, compose_covariance, invert, pose_covariance, poses_of, skew
from cmmsim.geometry.registration import register
from cmmsim.measuring.first_movement import frame_ends_of
from cmmsim.measuring.frame_solver import SolvedFrames, solve_frame
from cmmsim.measuring.layout_search import (
    ENOUGH,
    FEWEST_TAUGHT,
    bright_ellipses,
    candidate_points,
    find_layout,
)
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.observation import Observer
from cmmsim.measuring.sticker_windows import StickerObservation
from cmmsim.measuring.streaks import find_streaks, streak_message
from cmmsim.measuring.taught import Taught
from cmmsim.radiometry.stereo_images import FrameImages, StereoFrame, StereoImages

Solution = tuple[Array, Array, StickerObservation]


def by_registration(observation: StickerObservation, places: Array) -> Solution:
    """Return camera_from_body (4, 4), its covariance (6, 6) and the stickers used, by a rigid fit.

    The body's stickers were taught at ``places`` (n, 3), m. Raises LostError unless at least three
    stickers are seen that do not lie on one line.
    """
    result = register(places[observation.index], observation.points, observation.covariances)
    return result.transform, result.covariance, observation


def by_planes(observation: StickerObservation, body: MarkedBody, rough_normals: Array) -> Solution:
    """Return camera_from_body (4, 4), its covariance (6, 6) and the stickers used, by three planes.

    The rows of ``rough_normals`` (3, 3) are the normals of planes A, B, C in the camera frame.
    Raises LostError, which names the plane, if the stickers on a plane are too few or lie on one
    line.
    """
    frame, covariance = frame_of_points(
        observation.points,
        observation.covariances,
        body.plane_index[observation.index],
        rough_normals,
    )
    planes_from_body = _planes_from(body)
    return (
        frame @ planes_from_body,
        move_origin(frame, covariance, planes_from_body[:3, 3]),
        observation,
    )


def frames_by_planes(
    body: MarkedBody, points: Array, covariances: Array, rough_normals: Array
) -> Array:
    """Return camera_from_body (..., 4, 4) for many frames, as ``by_planes`` does for one.

    All n stickers must be seen, at points (..., n, 3) with covariances (..., n, 3, 3).
    ``rough_normals`` is (..., 3, 3).
    """
    return frames_of_points(points, covariances, body.plane_index, rough_normals)[0] @ _planes_from(
        body
    )


def _planes_from(body: MarkedBody) -> Array:
    """Return planes_from_body (4, 4), from the nominal planes of the body."""
    return invert(frame_from_planes(body.normals, body.offsets))


def move_origin(frame: Array, covariance: Array, origin: Array) -> Array:
    """Return the covariance (6, 6) of a frame's small error [dt, dphi] for another origin.

    ``frame`` (4, 4) is the transform of the frame, and ``origin`` (3,) is in its axes.
    """
    lever = np.eye(6)
    lever[:3, 3:] = -skew(frame[:3, :3] @ origin)
    return lever @ covariance @ lever.T


METHODS: tuple[str, ...] = ("registration", "planes")
# Tolerance of the search for nominal places, m. Stickers lie within about a millimetre of them.
NOMINAL_TOLERANCE = 0.003
# Tolerance of the search for taught places, m. They are accurate to micrometres, and points from
# whole images to tenths of a millimetre.
TAUGHT_TOLERANCE = 0.0005
# Fewest recognised stickers of a body with nominal places.
FEWEST_NOMINAL = 6


@dataclass(frozen=True)
class PoseEstimator(Observer):
    """Estimator that computes poses of a platform from images.

    Parameters
    ----------
    rig, noise, settings
        As in `Observer`.
    platform : MarkedBody
        Body that is measured.
    taught : Taught
        Result of teaching: places of the platform's stickers, and the base frame.
    method : {"registration", "planes"}
        Method that computes a pose from the stickers.
    common_covariance : callable, optional
        Function that returns the covariance (6, 6) that all poses have in common, at a pose (6,).
        By default, this covariance comes from the errors of teaching alone.

    Raises
    ------
    UnknownOptionError
        If there is no such method.

    Examples
    --------
    >>> sensor.estimator.method
    'registration'
    """

    platform: MarkedBody
    taught: Taught
    method: str = "registration"
    common_covariance: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownOptionError("method", self.method, METHODS)

    def __repr__(self) -> str:
        return (
            f"PoseEstimator({self.method}, {len(self.platform.sticker_ids)} stickers, {self.rig!r})"
        )

    def locate(self, images: StereoImages) -> Array:
        """Return a rough camera_from_platform (4, 4) from whole images, without a prior pose.

        If stickers are missing and the exposure time is not zero, streaks are searched as well.
        Raises the LostError of ``candidate_points`` and ``find_layout``.
        """
        ellipses = bright_ellipses(images, self)
        limits = self.settings.limits
        if self.settings.exposed_share == 0.0:
            return self._located(ellipses, limits)[0]
        with_streaks = replace(limits, largest_misfit=np.inf)
        try:
            transform, count = self._located(ellipses, limits)
        except LostError:
            return self._located(ellipses, with_streaks)[0]
        if count >= ENOUGH * len(self.taught.platform_places):
            return transform
        try:
            other, other_count = self._located(ellipses, with_streaks)
        except LostError:
            return transform
        return other if other_count > count else transform

    def measure(
        self,
        images: StereoImages,
        expected: Array,
        exposure_ends: tuple[Array, Array] | None = None,
        frame_ends: tuple[Array, Array] | None = None,
    ) -> tuple[Measurement, Array]:
        """Return the measurement, and the measured camera_from_platform (4, 4).

        ``expected`` is a first guess of camera_from_platform. ``exposure_ends`` are the expected
        transforms at the beginning and at the end of the exposure. ``frame_ends`` are those half a
        frame period before and after its middle, for rows or cameras that are not exposed at the
        same time. Without ``exposure_ends`` and without point spread, the covariance is too small
        if images of stickers move by more than half a pixel during the exposure. ``measure_anew``
        avoids this. Raises LostError.
        """
        return self.measured(
            self.observe(images, expected, *self._stickers, exposure_ends, frame_ends), expected
        )

    def measure_anew(self, images: StereoImages, expected: Array) -> tuple[Measurement, Array]:
        """Measure as ``measure`` does, and estimate the movement from this frame alone.

        Streaks show the movement during the exposure. Rows that are exposed one after another show
        the movement between their exposures. Raises LostError, which states the length of streaks
        if there are any.
        """
        settings = self.settings
        if settings.exposed_share == 0.0 and settings.row_share == 0.0:
            return self.measure(images, expected)
        read = self.read(images, expected, *self._stickers)
        streaks = None
        if read.found is None and settings.exposed_share > 0.0:
            streaks = find_streaks(read)
        frame_ends, factor = frame_ends_of(read) if settings.row_share > 0.0 else (None, 1.0)
        try:
            exposure_ends = None if streaks is None else streaks.exposure_ends
            seen = read.observed(exposure_ends, frame_ends)
            measurement, transform = self.measured(seen, expected)
            return replace(measurement, covariance=factor * measurement.covariance), transform
        except LostError as error:
            if streaks is None:
                raise
            raise LostError(f"{error}; {streak_message(streaks.longest_px)}") from error

    @property
    def _stickers(self) -> tuple[Array, Array]:
        """Taught places (n,3), m, and normals (n,3) of the stickers, in platform axes."""
        return self.taught.platform_places, self.platform.sticker_normals

    def _located(
        self, ellipses: tuple[EllipseFits, EllipseFits], limits: FitLimits
    ) -> tuple[Array, int]:
        """Return a rough camera_from_platform (4, 4), and the number of recognised stickers.

        Raises LostError.
        """
        points = candidate_points(ellipses, self, limits)
        transform, stickers, _ = find_layout(
            self.taught.platform_places, points, TAUGHT_TOLERANCE, FEWEST_TAUGHT, "platform"
        )
        return transform, len(stickers)

    def measured(self, seen: StickerObservation, near: Array) -> tuple[Measurement, Array]:
        """Return the measurement from observed stickers, and the measured camera_from_platform.

        ``near`` is a first guess of camera_from_platform. Raises LostError.
        """
        places = self.taught.platform_places
        return self._measured(solve_frame(seen, near, self, self.platform, places), 0)

    def measurement_of(self, solved: SolvedFrames, frame: int) -> Measurement:
        """Return the measurement, or the lost measurement, of one of several solved frames."""
        if solved.lost[frame]:
            return lost_measurement(solved.reason(frame))
        try:
            return self._measured(solved, frame)[0]
        except LostError as error:
            return lost_measurement(str(error))

    def _measured(self, solved: SolvedFrames, frame: int) -> tuple[Measurement, Array]:
        """Return the measurement of a solved frame, and its camera_from_platform (4, 4).

        Raises the LostError of ``by_planes``.
        """
        used = solved.used_in(frame)
        transform = solved.camera_from_body[frame]
        covariance = solved.covariances[frame]
        if self.method == "planes":
            rough_normals = self.platform.normals @ transform[:3, :3].T
            transform, covariance, used = by_planes(used, self.platform, rough_normals)
            # The stickers' covariances do not include the errors that stickers share.
            covariance = covariance + solved.shared[frame]
        pose, spread = self.in_base(transform, covariance)
        return self.measurement(pose, spread, used), transform

    def in_base(self, camera_from_platform: Array, covariances: Array) -> tuple[Array, Array]:
        """Return poses (..., 6) of the platform in the base frame and covariances (..., 6, 6).

        ``camera_from_platform`` is (..., 4, 4), and ``covariances`` (..., 6, 6) are those of its
        small errors [dt, dphi].
        """
        base_from_camera = self.taught.base_from_camera
        base_from_platform = base_from_camera @ camera_from_platform
        pose_covariances = pose_covariance(
            base_from_platform, compose_covariance(base_from_camera, covariances)
        )
        return poses_of(base_from_platform), pose_covariances

    def measurement(self, pose: Array, covariance: Array, used: StickerObservation) -> Measurement:
        """Return the measurement with a pose (6,) in the base frame and the stickers used.

        ``covariance`` (6, 6) is that of the pose's noise.
        """
        return Measurement(
            pose,
            covariance,
            used.points,
            used.covariances,
            used.left_pixels,
            used.right_pixels,
            self.platform.sticker_ids[used.index],
            True,
            common_at=self.common_at,
            pixel_variances=used.pixel_variances,
        )

    def common_at(self, pose: Array) -> Array:
        """Return the covariance (6, 6) that all poses have in common at a pose (6,)."""
        if self.common_covariance is None:
            return self.taught.calibration_covariance(pose, self.method)
        return self.common_covariance(pose)


def measure_frame(
    frame: StereoFrame, estimator: PoseEstimator, expected: Array | None = None
) -> Measurement:
    """Measure a stereo frame from any source.

    Parameters
    ----------
    frame : StereoFrame
        Both images.
    estimator : PoseEstimator
        Estimator of the images, such as ``sensor.estimator``.
    expected : array_like, shape (4, 4), optional
        Rough camera_from_platform. Without it, stickers are searched in the whole images.

    Returns
    -------
    Measurement
        Pose with its covariance, or the reason why the frame is lost.

    Raises
    ------
    ShapeError
        If the images have another size or bit depth than the estimator's cameras, or if
        ``expected`` is not (4, 4) and finite.
    CmmError
        If ``frame`` is not a StereoFrame, or ``estimator`` is not a PoseEstimator.

    Examples
    --------
    >>> import cmmsim
    >>> sensor = cmmsim.load_sensor("ctrack780", renderer="analytic")
    >>> known = cmmsim.load_sensor("ctrack780", renderer="analytic", taught=sensor.truth)
    >>> measure_frame(known.capture(known.home), known.estimator).ok
    True
    """
    require_kind(frame, StereoFrame, "a frame must be a StereoFrame(left, right)")
    require_estimator(estimator)
    require_fitting(frame, estimator)
    if expected is not None:
        expected = finite_array(
            expected, (4, 4), "the expected camera_from_platform must be (4,4) and finite"
        )
    images = FrameImages(frame)
    try:
        return estimator.measure_anew(
            images, estimator.locate(images) if expected is None else expected
        )[0]
    except LostError as error:
        return lost_measurement(str(error))


def require_estimator(estimator: object) -> None:
    """Raise CmmError unless ``estimator`` is a PoseEstimator."""
    wanted = "an estimator must be a PoseEstimator, such as sensor.estimator"
    require_kind(estimator, PoseEstimator, wanted)


def require_fitting(frame: StereoFrame, estimator: PoseEstimator) -> None:
    """Raise ShapeError unless images have the size and bit depth of the estimator's cameras."""
    for name, image, camera in zip(
        ("left", "right"), (frame.left, frame.right), estimator.rig.cameras, strict=True
    ):
        if image.shape != (camera.height, camera.width):
            raise ShapeError(
                f"the {name} image is {image.shape[1]} x {image.shape[0]} px, but its camera has "
                f"{camera.width} x {camera.height} px"
            )
        if image.dtype != estimator.noise.image_type:
            raise ShapeError(
                f"the {name} image is {image.dtype}, but the camera's bit_depth "
                f"{estimator.noise.bit_depth} requires {estimator.noise.image_type}"
            )
