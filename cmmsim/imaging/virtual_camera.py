"""The two virtual cameras: they look at the true scene and hand out noisy grey values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array, apply, pose_to_transform
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.image_formation import ImageFormation, Side
from cmmsim.imaging.motion_blur import sub_frame_poses
from cmmsim.imaging.scene import DiscStack
from cmmsim.imaging.whole_image import whole_image
from cmmsim.radiometry.fixed_pattern import FixedPattern, draw_pattern
from cmmsim.radiometry.images import StereoFrame, Windows
from cmmsim.radiometry.noise import CameraNoise

SUPERSAMPLING = 9


@dataclass(frozen=True)
class Quality:
    """How windows are made: supersampling per pixel and axis, and the number of exposures that are averaged."""

    supersampling: int = SUPERSAMPLING
    exposures: int = 1


class VirtualStereoCamera:
    """The true rig, its true place in the base frame, and what stands before it.

    Parameters: rig; camera_from_base (4,4); formation: how its light becomes images, its drawable's body 0 the
    platform and body 1 the base, the others being ``obstacle_names`` in order; noise; exposure in s; pattern_seed: of
    what differs from pixel to pixel.
    """

    def __init__(
        self,
        rig: StereoRig,
        camera_from_base: Array,
        formation: ImageFormation,
        noise: CameraNoise,
        obstacle_names: Sequence[str] = (),
        exposure: float = 0.0,
        pattern_seed: int = 0,
    ) -> None:
        self._rig, self._noise, self._formation = rig, noise, formation
        self._obstacle_names, self._exposure, self._pattern_seed = tuple(obstacle_names), exposure, pattern_seed
        self._from_base = [move @ camera_from_base for move in rig.from_camera]

    def look(
        self,
        pose: Array,
        rng: np.random.Generator,
        obstacles: Mapping[str, Array] | None = None,
        quality: Quality | None = None,
        pose_rate: Array | None = None,
    ) -> LiveImages:
        """One exposure of the platform and of the obstacles at base_from_body (4,4) each.

        ``pose`` (6,) of the platform in the middle of the exposure, ``pose_rate`` (6,) its time derivative; obstacles
        stand still.
        """
        poses = pose[None]
        if pose_rate is not None and self._exposure > 0.0:
            poses = sub_frame_poses(pose, pose_rate, self._exposure, self._sticker_pixels)
        moments = [self._placed(pose_to_transform(p), obstacles or {}) for p in poses]
        return LiveImages(self, moments, rng, quality or Quality())

    def radiance(
        self, placed: Sequence[Array], corners: NDArray[np.int_], size: int, supersampling: int
    ) -> NDArray[np.float32]:
        """Radiance (2, n, size, size) of windows at ``corners`` (2, n, 2) in the left and right image.

        ``placed``: camera_from_body (b,4,4) of all bodies for the left and the right camera.
        """
        sides = [Side(*side) for side in zip(self._rig.cameras, placed, corners, strict=True)]
        return np.stack(self._formation.windows(sides, size, supersampling))

    def whole_exposure(self, side: int, moments: Sequence[Array], supersampling: int) -> NDArray[np.float32]:
        """Mean radiance (height, width) of one whole image over the moments of an exposure."""
        return whole_image(self._formation, self._rig.cameras[side], moments, supersampling)

    def patterns(self) -> Sequence[FixedPattern | None]:
        """What differs from pixel to pixel of the left and of the right camera; None where nothing does."""
        return self._patterns if self._noise.has_pattern else (None, None)

    def centre_error_px(self, quality: Quality) -> float:
        """What drawing leaves in a sticker's centre, px rms."""
        return self._formation.centre_error_px(self._rig.cameras, quality.supersampling)

    @property
    def noise(self) -> CameraNoise:
        """The cameras' noise figures."""
        return self._noise

    @cached_property
    def _patterns(self) -> Sequence[FixedPattern]:
        return [
            draw_pattern(
                (camera.height, camera.width),
                self._noise.prnu,
                self._noise.dsnu,
                np.random.default_rng([self._pattern_seed, side]),
            )
            for side, camera in enumerate(self._rig.cameras)
        ]

    def _placed(self, base_from_platform: Array, obstacles: Mapping[str, Array]) -> list[Array]:
        """camera_from_body (b,4,4) of all bodies for the left and the right camera."""
        absent = np.diag([1.0, 1.0, 1.0, 1.0])
        absent[2, 3] = -1e3  # an obstacle without a place stands far behind both cameras
        return [
            np.stack(
                [c @ p for p in (base_from_platform, np.eye(4))]
                + [c @ obstacles[n] if n in obstacles else absent for n in self._obstacle_names]
            )
            for c in self._from_base
        ]

    def _sticker_pixels(self, pose: Array) -> Array:
        """Pixels (2, n, 2) of the platform's stickers."""
        drawable = self._formation.drawable
        places = np.array(
            [
                patch.discs[-1].centre
                for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
                if body == 0 and isinstance(patch, DiscStack)
            ]
        )
        return np.stack(
            [
                camera.project(apply(c @ pose_to_transform(pose), places))[0]
                for camera, c in zip(self._rig.cameras, self._from_base, strict=True)
            ]
        )


class LiveImages:
    """One exposure, drawn as far as it is read; moments: the placed bodies at each of its sub-frames."""

    def __init__(
        self,
        camera: VirtualStereoCamera,
        moments: Sequence[Sequence[Array]],
        rng: np.random.Generator,
        quality: Quality,
    ) -> None:
        self._camera, self._moments, self._rng, self._quality = camera, moments, rng, quality

    def full(self) -> StereoFrame:
        """Both whole images."""
        return StereoFrame(
            *(
                self._camera.noise.expose(
                    self._camera.whole_exposure(
                        side, [placed[side] for placed in self._moments], self._quality.supersampling
                    ),
                    self._rng,
                    pattern,
                )
                for side, pattern in enumerate(self._camera.patterns())
            )
        )

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x, y)."""
        radiance = self._camera.radiance(self._moments[0], corners, size, self._quality.supersampling)
        for placed in self._moments[1:]:
            radiance += self._camera.radiance(placed, corners, size, self._quality.supersampling)
        if len(self._moments) > 1:
            radiance /= np.float32(len(self._moments))
        pattern = self._pattern(corners, size)
        if self._quality.exposures == 1:
            return self._camera.noise.expose(radiance, self._rng, pattern)
        return self._camera.noise.mean_of_exposures(radiance, self._rng, self._quality.exposures, pattern)

    def _pattern(self, corners: NDArray[np.int_], size: int) -> FixedPattern | None:
        cut = [p.windows(at, size) for p, at in zip(self._camera.patterns(), corners, strict=True) if p is not None]
        return FixedPattern(np.stack([c.sensitivity for c in cut]), np.stack([c.offset for c in cut])) if cut else None
