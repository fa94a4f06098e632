"""From one stereo frame to a measurement (paper eq. 27 and 28). Knows nothing of true poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import finite_array, require_kind
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.errors import LostError, ShapeError, UnknownOptionError
from cmmsim.files.setup import MarkedBody
from cmmsim.geometry.plane_frame import frame_from_planes, frame_of_points, frames_of_points
from cmmsim.geometry.pose import Array, compose_covariance, invert, pose_covariance, skew, transform_to_pose
from cmmsim.geometry.registration import register
from cmmsim.pose_estimation.consistency import consistent
from cmmsim.pose_estimation.observation import Observer, StickerObservation
from cmmsim.pose_estimation.search import ENOUGH, FEWEST_TAUGHT, bright_ellipses, candidate_points, find_layout
from cmmsim.pose_estimation.streaks import drawn_out, find_streaks
from cmmsim.pose_estimation.taught import Taught
from cmmsim.radiometry.images import FrameImages, StereoFrame, StereoImages

Solution = tuple[Array, Array, StickerObservation]


def _nothing_in_common(pose: Array) -> Array:
    """Of a pose (6,), the covariance (6,6) that it has in common with others: none, or not known where it is lost."""
    return np.full((6, 6), 0.0 if np.isfinite(pose).all() else np.nan)


@dataclass(frozen=True)
class Measurement:
    """Pose of the platform in the base frame, and what it was made from.

    Its error has two parts. covariance (6,6) of pose (6,), m and rad, is that of the noise, new in every frame.
    common_covariance (6,6) is that of what is not known of rig and taught frames: one draw, the same in every frame, so
    that no mean over frames makes it smaller; NaN where it is not known (poses by planes with a rig that is not exact).
    They are never added in silence: the mean of N frames errs by covariance / N + common_covariance, a single one by
    ``single_covariance``. ``Sensor.common_errors`` says how the common part of one pose goes with that of another.

    points (n,3) and point_covariances (n,3,3) in the camera frame, m; left_pixels and right_pixels (n,2) sticker
    centres in the images as they are, distorted, and pixel_variances (n,) of a coordinate, px²; target_ids (n,) such as
    "A1"; common_at: what gives the common part at a pose (6,). When nothing could be measured ok is False, reason says
    why, and pose and covariances are NaN.
    """

    pose: Array
    covariance: Array
    points: Array
    point_covariances: Array
    left_pixels: Array
    right_pixels: Array
    target_ids: NDArray[np.str_]
    ok: bool
    reason: str = ""
    common_at: Callable[[Array], Array] = _nothing_in_common
    pixel_variances: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def common_covariance(self) -> Array:
        """Covariance (6,6) of the common part; found when it is asked for, which takes longer than to measure."""
        return self.common_at(self.pose)

    @property
    def single_covariance(self) -> Array:
        """Covariance (6,6) of this pose alone against the true one: noise and common part together."""
        return self.covariance + self.common_covariance

    def __post_init__(self) -> None:
        if self.pose.shape != (6,) or self.covariance.shape != (6, 6):
            raise ShapeError(f"pose (6,) and covariance (6,6) expected, got {self.pose.shape}, {self.covariance.shape}")
        finite = bool(np.isfinite(self.pose).all() and np.isfinite(self.covariance).all())
        if self.ok != finite or self.ok == bool(self.reason):
            raise ShapeError(
                f"a measurement is either ok and finite or lost for a reason, got ok={self.ok}, "
                f"finite={finite}, reason={self.reason!r}"
            )

    def __repr__(self) -> str:
        if not self.ok:
            return f"Measurement(lost: {self.reason})"
        place = ", ".join(f"{value:.6f}" for value in self.pose)
        spread = f"{_shown(self.covariance)} by noise"
        if self.common_covariance.any():
            spread += f", {_shown(self.common_covariance)} in common"
        return f"Measurement(pose [{place}] m, rad to {spread}, {len(self.target_ids)} stickers)"


def _shown(covariance: Array) -> str:
    """Standard deviations of place and turn in words."""
    shift, turn = (np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
    return f"{1e6 * shift:.2g} um and {1e6 * turn:.2g} urad"


def lost_measurement(reason: str) -> Measurement:
    """A measurement that holds no pose, and says why."""
    return measurement_without_stickers(np.full(6, np.nan), np.full((6, 6), np.nan), reason)


def measurement_without_stickers(pose: Array, covariance: Array, reason: str = "") -> Measurement:
    """A pose (6,) and its covariance (6,6) that no sticker stands behind; the reason why there is none where NaN."""
    points, covariances, pixels = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 2))
    names = np.array([], dtype=str)
    return Measurement(pose, covariance, points, covariances, pixels, pixels, names, not reason, reason)


def by_registration(observation: StickerObservation, places: Array) -> Solution:
    """camera_from_body (4,4), its covariance (6,6) and the stickers used, by a rigid fit of taught ``places`` (n,3).

    Raises LostError with fewer than three stickers off one line.
    """
    result = register(places[observation.index], observation.points, observation.covariances)
    return result.transform, result.covariance, observation


def by_planes(observation: StickerObservation, body: MarkedBody, towards: Array) -> Solution:
    """camera_from_body (4,4), its covariance (6,6) and the stickers used, by intersecting the three sticker planes.

    ``towards`` (3,3): rough normals of planes A, B, C in the camera frame. Raises LostError that names the plane.
    """
    frame, covariance = frame_of_points(
        observation.points, observation.covariances, body.plane_index[observation.index], towards
    )
    planes_from_body = _planes_from(body)
    return frame @ planes_from_body, move_origin(frame, covariance, planes_from_body[:3, 3]), observation


def frames_by_planes(body: MarkedBody, points: Array, covariances: Array, towards: Array) -> Array:
    """camera_from_body (...,4,4) as of ``by_planes`` where all stickers of a body are at points (..., n, 3) with
    covariances (..., n, 3, 3); ``towards`` (..., 3, 3)."""
    return frames_of_points(points, covariances, body.plane_index, towards)[0] @ _planes_from(body)


def _planes_from(body: MarkedBody) -> Array:
    """planes_from_body (4,4)."""
    return invert(frame_from_planes(body.normals, body.offsets))


def move_origin(frame: Array, covariance: Array, origin: Array) -> Array:
    """Covariance (6,6) of [dt, dphi] for another origin of the same rigid frame, ``origin`` (3,) in its own axes."""
    lever = np.eye(6)
    lever[:3, 3:] = -skew(frame[:3, :3] @ origin)
    return lever @ covariance @ lever.T


METHODS: tuple[str, ...] = ("registration", "planes")
NOMINAL_TOLERANCE = 0.003  # m: nominal places are known to about a millimetre
TAUGHT_TOLERANCE = 0.0005  # m: taught places are known to microns, points in a whole image to tenths of a millimetre
FEWEST_NOMINAL = 6  # stickers by whose nominal places a body is found


@dataclass(frozen=True)
class PoseEstimator(Observer):
    """Everything that turns images into poses: an observer, the platform, and what was taught of it.

    common_covariance: (6,6) that all poses have in common at a pose (6,); None: what teaching left.
    """

    platform: MarkedBody
    taught: Taught
    method: str = "registration"
    common_covariance: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownOptionError("method", self.method, METHODS)

    def __repr__(self) -> str:
        return f"PoseEstimator({self.method}, {len(self.platform.sticker_ids)} stickers, {self.rig!r})"

    def locate(self, images: StereoImages) -> Array:
        """Rough camera_from_platform (4,4) from whole images, without prior. Raises LostError.

        Where the cameras are exposed for some time and many stickers are missing, streaks are looked for as well.
        """
        ellipses, limits = bright_ellipses(images, self), self.settings.limits
        if self.settings.exposed_share == 0.0:
            return self._found(ellipses, limits)[0]
        streaks = replace(limits, largest_misfit=np.inf)
        try:
            found, count = self._found(ellipses, limits)
        except LostError:
            return self._found(ellipses, streaks)[0]
        if count >= ENOUGH * len(self.taught.platform_places):
            return found
        try:
            longer, more = self._found(ellipses, streaks)
        except LostError:
            return found
        return longer if more > count else found

    def measure(
        self, images: StereoImages, expected: Array, swept: tuple[Array, Array] | None = None
    ) -> tuple[Measurement, Array]:
        """Measurement near an expected camera_from_platform (4,4), and the measured one. Raises LostError.

        ``swept``: expected ones at the beginning and the end of the exposure. Where stickers are smeared over more than
        half a pixel and it is not told, a pose without point spread is worse than its covariance: ``measure_anew``.
        """
        return self.measured(self.observe(images, expected, *self._stickers, swept))

    def measure_anew(self, images: StereoImages, expected: Array) -> tuple[Measurement, Array]:
        """As ``measure`` where nothing is known of the movement: it is told from the streaks of the stickers.

        Raises LostError, which states the length of the streaks where they show.
        """
        if self.settings.exposed_share == 0.0:
            return self.measure(images, expected)
        read = self.read(images, expected, *self._stickers)
        streaks = None if read.found is not None else find_streaks(read)
        try:
            return self.measured(read.observed(None if streaks is None else streaks.swept))
        except LostError as error:
            if streaks is None:
                raise
            raise LostError(f"{error}; {drawn_out(streaks.longest_px)}") from error

    @property
    def _stickers(self) -> tuple[Array, Array]:
        """Taught places (n,3), m, and normals (n,3) of the platform's stickers, in its axes."""
        return self.taught.platform_places, self.platform.sticker_normals

    def _found(self, ellipses: tuple[EllipseFits, EllipseFits], limits: FitLimits) -> tuple[Array, int]:
        """Rough camera_from_platform (4,4) and the number of stickers that were recognised. Raises LostError."""
        points = candidate_points(ellipses, self, limits)
        place, stickers, _ = find_layout(
            self.taught.platform_places, points, TAUGHT_TOLERANCE, FEWEST_TAUGHT, "platform"
        )
        return place, len(stickers)

    def measured(self, seen: StickerObservation) -> tuple[Measurement, Array]:
        """Measurement, and measured camera_from_platform (4,4), from stickers. Raises LostError."""
        camera_from_platform, covariance, used = self._solve(seen)
        base_from_platform = self.taught.base_from_camera @ camera_from_platform
        spread = compose_covariance(self.taught.base_from_camera, covariance)
        pose = transform_to_pose(base_from_platform)
        measurement = Measurement(
            pose,
            pose_covariance(base_from_platform, spread),
            used.points,
            used.covariances,
            used.left_pixels,
            used.right_pixels,
            self.platform.sticker_ids[used.index],
            True,
            common_at=self.common_at,
            pixel_variances=used.pixel_variances,
        )
        return measurement, camera_from_platform

    def common_at(self, pose: Array) -> Array:
        """Covariance (6,6) that all poses have in common at a pose (6,)."""
        if self.common_covariance is None:
            return self.taught.calibration_covariance(pose, self.method)
        return self.common_covariance(pose)

    def _solve(self, seen: StickerObservation) -> Solution:
        used, result = consistent(seen, self, self.platform, self.taught.platform_places)
        if self.method == "planes":
            return by_planes(used, self.platform, self.platform.normals @ result.transform[:3, :3].T)
        return result.transform, result.covariance, used


def measure_frame(frame: StereoFrame, estimator: PoseEstimator, expected: Array | None = None) -> Measurement:
    """Measure a stereo frame from any source.

    ``expected`` (4,4) is a rough camera_from_platform; without it the stickers are searched in the whole images.
    Raises ShapeError for images of another size or bit depth than the estimator's cameras have, and CmmError for
    what is no frame or no estimator.
    """
    require_kind(frame, StereoFrame, "a frame must be a StereoFrame(left, right)")
    require_kind(estimator, PoseEstimator, "an estimator must be a PoseEstimator, such as sensor.estimator")
    require_fitting(frame, estimator)
    if expected is not None:
        expected = finite_array(expected, (4, 4), "the expected camera_from_platform must be (4,4) and finite")
    images = FrameImages(frame)
    try:
        return estimator.measure_anew(images, estimator.locate(images) if expected is None else expected)[0]
    except LostError as error:
        return lost_measurement(str(error))


def require_fitting(frame: StereoFrame, estimator: PoseEstimator) -> None:
    """Raise ShapeError for images of another size or bit depth than the estimator's cameras have."""
    for name, image, camera in zip(("left", "right"), (frame.left, frame.right), estimator.rig.cameras, strict=True):
        if image.shape != (camera.height, camera.width):
            raise ShapeError(
                f"the {name} image is {image.shape[1]} x {image.shape[0]} px, but its camera has "
                f"{camera.width} x {camera.height} px"
            )
        if image.dtype != estimator.noise.image_type:
            raise ShapeError(
                f"the {name} image is {image.dtype}, but the camera's bit_depth "
                f"{estimator.noise.bit_depth} makes {estimator.noise.image_type}"
            )
