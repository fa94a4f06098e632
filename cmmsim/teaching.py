"""Teaching (paper section 4.2): the frames of base and platform from their sticker planes.

The base stands still, and its stickers are averaged over many exposures. The platform follows a
smooth path. Its stickers are observed at each pose, all observations are laid onto each other by
registration, and the planes are put through the mean constellation. Different poses put the
stickers on different parts of a pixel, which averages out the image formation's own error as well.

The centres are always those of the maximum-likelihood fit, whatever detector the sensor measures
with. The base is seen at one pose only, so that a detector's bias would stay in every pose.

The search windows hold the largest image of a sticker. This is the larger of two images: the one at
the nearest working distance, assumed a fifth nearer than the rig's target, and the largest one that
both cameras see at teaching.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.errors import LostError, TeachingError
from cmmsim.files.rig_and_bodies import MarkedBody, marked_body, rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import Array, apply, apply_each, compose_covariance, invert
from cmmsim.geometry.registration import register, register_sets
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.scene_bodies import placed_stickers
from cmmsim.imaging.stereo_camera import Quality
from cmmsim.measuring.layout_search import bright_ellipses, candidate_points, find_layout
from cmmsim.measuring.observation import Observer, StickerExposure, StickerObservation, faces_camera
from cmmsim.measuring.pose_estimator import (
    FEWEST_NOMINAL,
    NOMINAL_TOLERANCE,
    by_planes,
    frames_by_planes,
)
from cmmsim.measuring.taught import Taught, setup_of
from cmmsim.radiometry.stereo_images import StereoImages

Progress = Callable[[int, int], None]
# Reach of the teaching path about home, m and rad.
SHIFT = 0.008
TURN = 0.03
CYCLES = np.array([1, 2, 3, 3, 1, 2])
# m: in averaged exposures, a whole sticker is within a few microns of its place.
LARGEST_GAP = 1e-4
PHASES = np.array([0.0, 0.9, 1.7, 2.6, 0.4, 1.3])
# Half the side of the fitted part over a sticker's radius at the rig's target.
ROOM = 1.35
# px on each side of the largest sticker at teaching: half a pixel is lost to rounding.
SMALLEST_ROOM_PX = 0.7
SMALLEST_FIT = 12
SMALLEST_BLURRED_FIT = 14
# px on each side, at least, for the blur of point spread and exposure.
BLUR_ROOM = 1.0
# Side of a window over that of the part that is fitted.
WINDOW_SHARE = 7 / 6


@dataclass(frozen=True)
class TeachingPlan:
    """Plan of teaching.

    It states the quality of the base's views, the quality and number of the platform's views, and
    the sizes of windows in px.
    """

    base: Quality = field(default_factory=lambda: Quality(supersampling=32, exposures=4000))
    platform: Quality = field(default_factory=lambda: Quality(supersampling=12, exposures=30))
    poses: int = 64
    base_window: int = 20
    first_window: int = 24
    platform_window: int = 16


class Camera(Protocol):
    """Two cameras before the true scene."""

    def look(
        self, pose: Array, rng: np.random.Generator, *, quality: Quality | None = None
    ) -> StereoImages | StickerExposure:
        """Take one exposure of the platform at a pose (6,)."""

    def centre_error_px(self, quality: Quality) -> float:
        """Return the error of a sticker's centre that drawing leaves, px rms."""


@dataclass(frozen=True)
class Teacher:
    """Instruments and plan of teaching."""

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
        """Teach base and platform around the pose ``home`` (6,). Raises TeachingError."""
        steps = self.plan.poses + 2
        report = progress or (lambda done, total: None)
        report(0, steps)
        try:
            path = teaching_path(home, self.plan.poses)
            ellipses = bright_ellipses(self.camera.look(path[0], rng), self.observer)
            points = candidate_points(ellipses, self.observer, self.observer.settings.limits)
            start = [
                find_layout(body.nominal, points, NOMINAL_TOLERANCE, FEWEST_NOMINAL, body.name)[0]
                for body in (self.base, self.platform)
            ]
            report(1, steps)
            # The error of this one view stays in every pose, so it is averaged longest.
            base = self._look_at(
                self.base,
                start[0],
                self.base.nominal,
                path[0],
                rng,
                self.plan.base,
                self.plan.base_window,
            )
            camera_from_base, base_covariance, base = by_planes(
                base, self.base, _towards(self.base, start[0])
            )
            report(2, steps)
            seen = self._platform_views(start[1], path, rng, lambda k: report(k + 2, steps))
        except LostError as error:
            raise TeachingError(f"teaching failed: {error}") from error
        base_from_camera = invert(camera_from_base)
        places, place_covariances, platform_covariance = platform_frame(self.platform, seen)
        return Taught(
            sensor_name,
            base_from_camera,
            compose_covariance(base_from_camera, base_covariance),
            places,
            place_covariances,
            platform_covariance,
            apply(base_from_camera, base.points),
        )

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
        """Observe all stickers of a body in averaged exposures. Raises LostError when one is
        missing.
        """
        usual = self.observer.settings
        # Averaged exposures have so little noise that the model's own error shows: no misfit is too
        # large.
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
                "cameras" + self._outside(body, missing, apply(expected, places))
            )
        return seen

    def _outside(self, body: MarkedBody, missing: NDArray[np.int_], points: Array) -> str:
        """Name the missing stickers that lie beside an image, where no window could find them."""
        outside = missing[~np.all(self.observer.rig.project(points[missing])[1], axis=0)]
        return (
            f"; {', '.join(body.sticker_ids[outside])} lie outside of an image"
            if len(outside)
            else ""
        )

    def _platform_views(
        self, rough: Array, path: Array, rng: np.random.Generator, report: Callable[[int], None]
    ) -> list[StickerObservation]:
        """Observe the platform along the teaching path, near the pose predicted from the views
        before.
        """
        places = self.platform.nominal
        last = rough
        step = np.eye(4)
        seen = []
        for k, pose in enumerate(path):
            # Two views must be seen before the movement can be predicted: wider windows until then.
            size = self.plan.first_window if k < 2 else self.plan.platform_window
            seen.append(
                self._look_at(
                    self.platform, last @ step, places, pose, rng, self.plan.platform, size
                )
            )
            if k == 0:
                body_from_camera = invert(
                    by_planes(seen[0], self.platform, _towards(self.platform, rough))[0]
                )
                places = apply(body_from_camera, seen[0].points)
            now = register(places, seen[-1].points, seen[-1].covariances).transform
            self._require_rigid(places, now, seen[-1])
            step = invert(last) @ now if k else step
            last = now
            report(k + 1)
        return seen

    def _require_rigid(
        self, places: Array, camera_from_body: Array, seen: StickerObservation
    ) -> None:
        """Raise LostError when a sticker has moved against the others, because it is partly
        hidden.
        """
        gaps = np.linalg.norm(apply(camera_from_body, places) - seen.points, axis=1)
        depth = np.linalg.norm(seen.points, axis=1).max()
        focal = self.observer.rig.left.focal_px
        limit = LARGEST_GAP + self.observer.settings.line_error_px * depth / focal
        if gaps.max() > limit:
            worst = self.platform.sticker_ids[gaps.argmax()]
            raise LostError(
                f"{self.platform.name}: sticker {worst} is {gaps.max() * 1e6:.0f} um off its "
                f"place, at most {limit * 1e6:.0f} um; it may be partly hidden"
            )


def platform_frame(
    platform: MarkedBody, seen: list[StickerObservation]
) -> tuple[Array, Array, Array]:
    """Return sticker places (n, 3) on the platform with their covariances (n, 3, 3).

    The third result is the covariance (6, 6) of the platform frame. Each view observes all
    stickers.
    """
    views = np.stack([one.points for one in seen]), np.stack([one.covariances for one in seen])
    mean, covariances = mean_constellation(*views)
    towards = _towards(platform, register(platform.nominal, mean, covariances).transform)
    whole = replace(seen[0], points=mean, covariances=covariances)
    mean_from_body, frame_covariance, _ = by_planes(whole, platform, towards)
    body_from_mean = invert(mean_from_body)
    turn = body_from_mean[:3, :3]
    return (
        apply(body_from_mean, mean),
        turn @ covariances @ turn.T,
        compose_covariance(body_from_mean, frame_covariance),
    )


def platform_places(platform: MarkedBody, points: Array, covariances: Array) -> Array:
    """Return the sticker places (c, n, 3) that each of c teachings finds, as ``platform_frame``.

    The stickers are seen at points (c, v, n, 3) with covariances (c, v, n, 3, 3) in v views each.
    """
    mean, covariances = mean_constellation(points, covariances)
    towards = _towards(platform, register_sets(platform.nominal, mean, covariances).transform)
    return apply_each(invert(frames_by_planes(platform, mean, covariances, towards)), mean)


def teaching_path(home: Array, count: int) -> Array:
    """Return a smooth closed path of poses (count, 6) that starts near ``home``.

    It visits many sub-pixel positions.
    """
    angle = 2.0 * np.pi * np.arange(count)[:, None] / count * CYCLES + PHASES
    return home + np.array([SHIFT] * 3 + [TURN] * 3) * np.sin(angle)


def _towards(body: MarkedBody, camera_from_body: Array) -> Array:
    """Return normals (..., 3, 3) of the planes in the camera frame, for camera_from_body (..., 4,
    4).
    """
    return np.asarray(body.normals @ camera_from_body[..., :3, :3].swapaxes(-1, -2))


def mean_constellation(points: Array, covariances: Array) -> tuple[Array, Array]:
    """Return the weighted mean (..., n, 3) of views of the same stickers, laid onto each other.

    The mean lies near the first view. The second result is its covariances (..., n, 3, 3). Views
    are (..., v, n, 3) with covariances (..., v, n, 3, 3).
    """
    weights = np.linalg.inv(covariances)
    mean = points[..., 0, :, :]
    spread = covariances[..., 0, :, :, :]
    # The weights turn with the views, so mean and transforms are found in turns; three settle them.
    for _ in range(3):
        sets = np.broadcast_to(mean[..., None, :, :], points.shape).reshape(-1, *points.shape[-2:])
        found = register_sets(
            sets, points.reshape(sets.shape), covariances.reshape(*sets.shape, 3)
        ).transform
        to_mean = invert(found).reshape(*points.shape[:-2], 4, 4)
        turn = to_mean[..., None, :3, :3]
        turned = turn @ weights @ turn.swapaxes(-1, -2)
        weighted = (turned @ apply_each(to_mean, points)[..., None]).sum(axis=-4)
        spread = np.linalg.inv(turned.sum(axis=-4))
        mean = (spread @ weighted)[..., 0]
    return mean, spread


@dataclass(frozen=True)
class WindowSizes:
    """Sides in px of windows, and of the fitted part around the bright spot.

    ``growth`` is the fitted part's side over that for the smallest stickers.
    """

    window: int
    fit: int
    growth: float

    def plan(self) -> TeachingPlan:
        """Return a teaching plan with windows enlarged by the same factor."""
        plan = TeachingPlan()
        names = ("base_window", "first_window", "platform_window")
        return replace(
            plan, **{name: 2 * round(0.5 * self.growth * getattr(plan, name)) for name in names}
        )


def window_sizes(target_px: float, largest_px: float, psf_px: float, blurred: bool) -> WindowSizes:
    """Return sizes for stickers whose radius is ``target_px`` at the rig's target.

    At teaching it is up to ``largest_px``. The point spread has the sigma ``psf_px``; ``blurred``
    says that it or a moving platform blurs the stickers.
    """
    smallest, blur = (
        (SMALLEST_BLURRED_FIT, max(BLUR_ROOM, psf_px)) if blurred else (SMALLEST_FIT, 0.0)
    )
    reach = max(ROOM * target_px, largest_px + SMALLEST_ROOM_PX)
    fit = max(smallest, 2 * int(np.ceil(reach + blur)))
    return WindowSizes(2 * int(0.5 * WINDOW_SHARE * fit), fit, fit / smallest)


def radius_at(rig: StereoRig, camera_from_base: Array, target: Array, radius: float) -> float:
    """Return the radius in px of a sticker of ``radius`` m at ``target`` (3,) m in base axes.

    The sticker faces the nearer camera.
    """
    distances = [
        float(np.linalg.norm(apply(move @ camera_from_base, target))) for move in rig.from_camera
    ]
    return max(
        radius * float(camera.focal_lengths.max()) / distance
        for camera, distance in zip(rig.cameras, distances, strict=True)
    )


def largest_radius(
    rig: StereoRig, camera_from_body: Array, body: MarkedBody, radius: float
) -> float:
    """Return the longest half axis in px of the stickers of a body that both cameras see; 0 without
    any.
    """
    normals = body.sticker_normals
    seen = np.all(rig.project(apply(camera_from_body, body.nominal))[1], axis=0)
    for move in rig.from_camera:
        placed = move @ camera_from_body
        seen &= faces_camera(apply(placed, body.nominal), normals @ placed[:3, :3].T)
    _, shapes = sticker_outlines(rig, camera_from_body, body.nominal[seen], normals[seen], radius)
    return float(np.linalg.eigvalsh(shapes).max(initial=0.0))


def exactly_taught(file: SensorFile) -> Taught:
    """Return what teaching without any error would find: the true frames and places of a sensor
    file.

    All covariances are zero, for studies of the observation noise alone. Raises SensorFileError.
    """
    _, camera_from_base = rig_from_file(file.rig)
    platform, base = (
        placed_stickers(marked_body(name, section), file.stickers, stream)
        for stream, (name, section) in enumerate((("platform", file.platform), ("base", file.base)))
    )
    return Taught.without_error(file.name, invert(camera_from_base), platform, base, setup_of(file))
