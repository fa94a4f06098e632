"""Teaching (paper section 4.2), which determines the frames of base and platform by stickers.

The base stands still, and its stickers are observed in the mean of many exposures. The platform
follows a smooth path. Its stickers are observed at each pose, and registration moves all
observations onto each other. The planes are fitted to the mean constellation. The stickers have
different sub-pixel positions at different poses, so errors of the image formation average out too.

The centres always come from the maximum-likelihood fit, whichever detector the sensor uses later.
The base is seen at one pose only. If another detector were used here, every measured pose would
therefore contain the bias of that detector.

The windows have room for the largest image of a sticker. This is the larger of two images: the
image at the nearest working distance, which is assumed to be a fifth shorter than the distance of
the rig's target, and the largest image that both cameras see at teaching.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.errors import LostError, TeachingError, TeachingWarning
from cmmsim.files.rig_and_bodies import MarkedBody, marked_body, rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.plane_frame import PLANE_NAMES
from cmmsim.geometry.pose import Array, apply, compose_covariance, invert
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.scene_bodies import placed_stickers
from cmmsim.imaging.stereo_camera import Quality
from cmmsim.measuring.constellation import plane_normals, platform_frame
from cmmsim.measuring.layout_search import bright_ellipses, candidate_points, find_layout
from cmmsim.measuring.observation import Observer, StickerExposure, faces_camera
from cmmsim.measuring.pose_estimator import (
    FEWEST_NOMINAL,
    NOMINAL_TOLERANCE,
    by_planes,
)
from cmmsim.measuring.sticker_windows import StickerObservation
from cmmsim.measuring.taught import Taught, setup_of
from cmmsim.radiometry.stereo_images import StereoImages

Progress = Callable[[int, int], None]
# Amplitude of the teaching path about home, m and rad.
SHIFT = 0.008
TURN = 0.03
# Number of cycles of each pose coordinate on the path.
CYCLES = np.array([1, 2, 3, 3, 1, 2])
# Teaching fails if a sticker of the platform is farther than this from its expected position in
# averaged exposures, m. It is off by a few micrometres unless it is partly hidden.
LARGEST_GAP = 1e-4
# A warning is given if the rms distance between the two rays of a sticker of the base exceeds this,
# in standard deviations. It is 1.2 to 1.4 if cameras and stickers are as stated.
LARGEST_PARTING = 3.0
# Distance that is added to LARGEST_GAP for errors of the print, in their standard deviations.
PRINT_REACH = 20.0
# Phase of each pose coordinate at the start of the path, rad.
PHASES = np.array([0.0, 0.9, 1.7, 2.6, 0.4, 1.3])
# Only the part of a window around the bright spot is fitted. Ratio of half the side of this part to
# a sticker's radius at the rig's target.
ROOM = 1.35
# Smallest free margin around the largest sticker at teaching, px. Rounding can use up half a pixel.
SMALLEST_ROOM_PX = 0.7
# Smallest sides of the fitted part, px, for sharp and for blurred stickers.
SMALLEST_FIT = 12
SMALLEST_BLURRED_FIT = 14
# Smallest margin in px on each side for the blur of point spread and exposure.
BLUR_ROOM = 1.0
# Ratio of the side of a window to the side of the fitted part.
WINDOW_SHARE = 7 / 6


@dataclass(frozen=True)
class TeachingPlan:
    """Plan of teaching.

    ``base`` and ``platform`` are the qualities of the views. ``poses`` is the number of views of
    the platform. The other entries are sides of windows, px: for the base, for the first two views
    of the platform, and for its other views.
    """

    base: Quality = field(default_factory=lambda: Quality(supersampling=32, exposures=4000))
    platform: Quality = field(default_factory=lambda: Quality(supersampling=12, exposures=30))
    poses: int = 64
    base_window: int = 20
    first_window: int = 24
    platform_window: int = 16


class Camera(Protocol):
    """Interface of two cameras in front of the true scene."""

    def look(
        self, pose: Array, rng: np.random.Generator, *, quality: Quality | None = None
    ) -> StereoImages | StickerExposure:
        """Take an exposure, or the mean of several, of the platform at a pose (6,)."""

    def centre_error_px(self, quality: Quality) -> float:
        """Return the error of a sticker's centre that drawing causes, px rms."""


@dataclass(frozen=True)
class Teacher:
    """Teaching of a sensor: its cameras, its observer, both bodies and the plan."""

    camera: Camera
    observer: Observer
    platform: MarkedBody
    base: MarkedBody
    plan: TeachingPlan = field(default_factory=TeachingPlan)

    def teach(
        self,
        sensor_name: str,
        home: Array,
        rng: np.random.Generator,
        progress: Progress | None = None,
    ) -> Taught:
        """Teach base and platform around the pose ``home`` (6,).

        ``progress`` is called with the number of steps done and their total. Raises TeachingError
        if a sticker is not seen, or if the stickers are not found or do not determine the frames.
        """
        steps = self.plan.poses + 2
        report = progress or (lambda done, total: None)
        report(0, steps)
        try:
            path = teaching_path(home, self.plan.poses)
            ellipses = bright_ellipses(self.camera.look(path[0], rng), self.observer)
            points = candidate_points(ellipses, self.observer, self.observer.settings.limits)
            rough_poses = [
                find_layout(body.nominal, points, NOMINAL_TOLERANCE, FEWEST_NOMINAL, body.name)[0]
                for body in (self.base, self.platform)
            ]
            report(1, steps)
            # Every measured pose contains the error of this single view, so its mean is taken over
            # the most exposures.
            base = self._look_at(
                self.base,
                rough_poses[0],
                self.base.nominal,
                path[0],
                rng,
                self.plan.base,
                self.plan.base_window,
            )
            self._warn_of_parted_rays(base)
            base = replace(base, covariances=base.covariances + self._constant(base.points))
            camera_from_base, base_covariance, base = by_planes(
                base, self.base, plane_normals(self.base, rough_poses[0])
            )
            report(2, steps)
            seen = self._platform_views(rough_poses[1], path, rng, lambda k: report(k + 2, steps))
        except LostError as error:
            raise TeachingError(f"teaching failed: {error}") from error
        base_from_camera = invert(camera_from_base)
        constellation = platform_frame(self.platform, seen, self._constant(seen[0].points))
        places, place_covariances, platform_covariance = constellation
        return Taught(
            sensor_name,
            base_from_camera,
            compose_covariance(base_from_camera, base_covariance),
            places,
            place_covariances,
            platform_covariance,
            apply(base_from_camera, base.points),
        )

    def _warn_of_parted_rays(self, base: StickerObservation) -> None:
        """Warn if the two rays of the base's stickers are farther apart than noise explains.

        There is no test if known errors of the rig or of the print separate the rays as well.
        """
        settings = self.observer.settings
        exact = settings.line_error_px == 0.0 and not settings.allowed.known
        parting = float(np.sqrt(np.mean(base.rays**2)))
        if exact and parting > LARGEST_PARTING:
            warnings.warn(
                f"teaching: the two rays of a sticker of the {self.base.name} pass each other at "
                f"{parting:.1f} standard deviations, rms, but with the stated cameras and stickers "
                f"it is at most {LARGEST_PARTING:g}; poses have larger errors than they state",
                TeachingWarning,
                stacklevel=2,
            )

    def _constant(self, points: Array) -> Array:
        """Return the covariances (n, 3, 3) of points due to errors that all views share."""
        return self.observer.settings.allowed.constant_covariances(self.observer.rig, points)

    def _look_at(
        self,
        body: MarkedBody,
        expected: Array,
        places: Array,
        pose: Array,
        rng: np.random.Generator,
        quality: Quality,
        window_size: int,
    ) -> StickerObservation:
        """Observe all stickers of a body in averaged exposures of the platform at ``pose`` (6,).

        ``expected`` (4, 4) is the expected camera_from_body, and ``places`` (n, 3) m are the
        expected positions of the stickers in body axes. Raises LostError if a sticker is missing.
        """
        usual = self.observer.settings
        # Averaged exposures have so little noise that errors of the model dominate the misfit, so
        # the misfit is not limited.
        settings = replace(
            usual,
            window_size=window_size,
            limits=replace(usual.limits, largest_misfit=np.inf),
            largest_ray_gap=np.inf,
            detector=DEFAULT_DETECTOR,
            centre_error_px=self.camera.centre_error_px(quality),
        )
        noise = replace(self.observer.noise, frames=quality.exposures)
        observer = replace(self.observer, noise=noise, settings=settings)
        seen = observer.observe(
            self.camera.look(pose, rng, quality=quality), expected, places, body.sticker_normals
        )
        if len(seen.index) < len(places):
            missing = np.setdiff1d(np.arange(len(places)), seen.index)
            raise LostError(
                f"{body.name}: stickers {', '.join(body.sticker_ids[missing])} not seen by both "
                "cameras"
                + self._outside(body, missing, apply(expected, places))
                + f"; teaching needs every sticker: {_removal(body, missing)}, or move the cameras"
            )
        return seen

    def _outside(self, body: MarkedBody, missing: NDArray[np.int_], points: Array) -> str:
        """Return a text that names missing stickers outside of an image, or an empty text."""
        outside = missing[~np.all(self.observer.rig.project(points[missing])[1], axis=0)]
        return (
            f"; {', '.join(body.sticker_ids[outside])} lie outside of an image"
            if len(outside)
            else ""
        )

    def _platform_views(
        self, rough: Array, path: Array, rng: np.random.Generator, report: Callable[[int], None]
    ) -> list[StickerObservation]:
        """Observe the platform along the teaching path. Earlier views predict the next pose.

        ``rough`` (4, 4) is a rough camera_from_platform in the first view.
        """
        places = self.platform.nominal
        previous = rough
        step = np.eye(4)
        seen = []
        for k, pose in enumerate(path):
            # The movement can be predicted after two views. Until then, windows are larger.
            size = self.plan.first_window if k < 2 else self.plan.platform_window
            seen.append(
                self._look_at(
                    self.platform, previous @ step, places, pose, rng, self.plan.platform, size
                )
            )
            if k == 0:
                body_from_camera = invert(
                    by_planes(seen[0], self.platform, plane_normals(self.platform, rough))[0]
                )
                places = apply(body_from_camera, seen[0].points)
            current = register(places, seen[-1].points, seen[-1].covariances).transform
            self._require_rigid(places, current, seen[-1])
            step = invert(previous) @ current if k else step
            previous = current
            report(k + 1)
        return seen

    def _require_rigid(
        self, places: Array, camera_from_body: Array, seen: StickerObservation
    ) -> None:
        """Raise LostError if a sticker of the platform is too far from its expected position."""
        distances = np.linalg.norm(apply(camera_from_body, places) - seen.points, axis=1)
        depth = np.linalg.norm(seen.points, axis=1).max()
        focal = self.observer.rig.left.focal_px
        settings = self.observer.settings
        errors = settings.line_error_px + PRINT_REACH * settings.allowed.changing_px
        limit = LARGEST_GAP + errors * depth / focal
        if distances.max() > limit:
            worst = distances.argmax()
            spread = settings.optics.psf_px
            raise LostError(
                f"{self.platform.name}: sticker {self.platform.sticker_ids[worst]} is "
                f"{distances.max() * 1e6:.0f} um off its expected position, but at most "
                f"{limit * 1e6:.0f} um is allowed; if it is partly hidden, "
                f"{_removal(self.platform, np.array([worst]))}"
                + (f"; or lens.psf_px = {spread:g} blurs the edge of its ring" if spread else "")
            )


def _removal(body: MarkedBody, stickers: NDArray[np.int_]) -> str:
    """Return the advice to remove stickers, given by their indices, from their lists."""
    planes = sorted({PLANE_NAMES[k] for k in body.plane_index[stickers]})
    lists = " and ".join(f"{body.name}.planes.{plane}.stickers" for plane in planes)
    return f"remove {'it' if len(stickers) == 1 else 'them'} from {lists}"


def teaching_path(home: Array, count: int) -> Array:
    """Return a smooth closed path of poses (count, 6) that starts near ``home``.

    Along the path, the stickers pass many sub-pixel positions.
    """
    angle = 2.0 * np.pi * np.arange(count)[:, None] / count * CYCLES + PHASES
    return home + np.array([SHIFT] * 3 + [TURN] * 3) * np.sin(angle)


@dataclass(frozen=True)
class WindowSizes:
    """Sides in px of windows, and of the fitted part around the bright spot.

    ``growth`` is the ratio of the fitted part's side to its smallest allowed side.
    """

    window: int
    fit: int
    growth: float

    def plan(self) -> TeachingPlan:
        """Return a teaching plan with windows enlarged by the factor ``growth``."""
        plan = TeachingPlan()
        names = ("base_window", "first_window", "platform_window")
        return replace(
            plan, **{name: 2 * round(0.5 * self.growth * getattr(plan, name)) for name in names}
        )


def window_sizes(target_px: float, largest_px: float, psf_px: float, blurred: bool) -> WindowSizes:
    """Return window sizes for stickers with the image radius ``target_px`` at the rig's target.

    ``largest_px`` is the largest image radius at teaching, and ``psf_px`` the sigma of the point
    spread. ``blurred`` is True if the point spread or movement during the exposure blurs the
    stickers.
    """
    smallest, blur = (
        (SMALLEST_BLURRED_FIT, max(BLUR_ROOM, psf_px)) if blurred else (SMALLEST_FIT, 0.0)
    )
    reach = max(ROOM * target_px, largest_px + SMALLEST_ROOM_PX)
    fit = max(smallest, 2 * int(np.ceil(reach + blur)))
    return WindowSizes(2 * int(0.5 * WINDOW_SHARE * fit), fit, fit / smallest)


def image_radii(rig: StereoRig, camera_from_body: Array, body: MarkedBody, radius: float) -> Array:
    """Return the semi-axes (2, k, 2), px, in the images of the k stickers that both cameras see."""
    normals = body.sticker_normals
    seen = np.all(rig.project(apply(camera_from_body, body.nominal))[1], axis=0)
    for move in rig.from_camera:
        placed = move @ camera_from_body
        seen &= faces_camera(apply(placed, body.nominal), normals @ placed[:3, :3].T)
    _, shapes = sticker_outlines(rig, camera_from_body, body.nominal[seen], normals[seen], radius)
    return np.asarray(np.linalg.eigvalsh(shapes), dtype=float)


def exactly_taught(file: SensorFile) -> Taught:
    """Return the result of a teaching without errors: the true frames and sticker positions.

    All covariances are zero. Raises SensorFileError for an impossible rig.
    """
    _, camera_from_base = rig_from_file(file.rig)
    platform, base = (
        placed_stickers(marked_body(name, section), file.stickers, stream)
        for stream, (name, section) in enumerate((("platform", file.platform), ("base", file.base)))
    )
    return Taught.without_error(file.name, invert(camera_from_base), platform, base, setup_of(file))
