"""Exposures of two cameras: poses during the exposure, mean light, and noise."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array, apply_each, rigid, transforms_of
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.row_sweep import drawn_at_middle_rows, row_sweeps
from cmmsim.imaging.scene_bodies import DiscStack
from cmmsim.imaging.whole_image import whole_image
from cmmsim.radiometry.noise import CameraNoise, FixedPattern, draw_pattern
from cmmsim.radiometry.stereo_images import StereoFrame, Windows

# Largest movement of a sticker from one of the sub-frames of an exposure to the next.
LARGEST_STEP_PX = 0.3
# An exposure that needs more sub-frames is refused.
MOST_SUB_FRAMES = 500
# Usual number of drawn samples per pixel and axis.
SUPERSAMPLING = 9

# Transforms camera_from_body (b, 4, 4) of all bodies for the left and the right camera, at the
# moment of each sub-frame.
Moments = Sequence[Sequence[Array]]


def sub_frame_poses(
    poses: Array, pose_rates: Array, exposure: float, sticker_pixels: Callable[[Array], Array]
) -> list[Array]:
    """Return, for each of N exposures, poses (m, 6) whose mean image is the image of the exposure.

    Each exposure is divided into m equal parts, and each pose belongs to the middle of a part.
    ``poses`` (N, 6) are the poses in the middle of the exposures, and ``pose_rates`` (N, 6) are
    constant. ``sticker_pixels`` returns the pixels (2, N, n, 2) of all stickers at poses (N, 6).
    Raises CmmError if a sticker moves too far for MOST_SUB_FRAMES parts.
    """
    halves = 0.5 * exposure * pose_rates
    moved = np.linalg.norm(
        sticker_pixels(poses + halves) - sticker_pixels(poses - halves), axis=-1
    ).max(axis=(0, 2))
    counts = np.maximum(1, np.ceil(moved / LARGEST_STEP_PX)).astype(int)
    for far, rate in zip(
        moved[counts > MOST_SUB_FRAMES], pose_rates[counts > MOST_SUB_FRAMES], strict=True
    ):
        raise CmmError(
            f"a sticker moves {far:.0f} px during the exposure of {exposure:g} s at pose rate "
            f"{rate.tolist()}, but at most {MOST_SUB_FRAMES * LARGEST_STEP_PX:.0f} px can be drawn"
        )
    fractions = [(2.0 * np.arange(count) + 1.0) / count - 1.0 for count in counts]
    return [
        pose + fraction[:, None] * half
        for pose, fraction, half in zip(poses, fractions, halves, strict=True)
    ]


@dataclass(frozen=True)
class Quality:
    """Quality of windows: drawn samples per pixel and axis, and number of averaged exposures."""

    supersampling: int = SUPERSAMPLING
    exposures: int = 1


@dataclass(frozen=True)
class VirtualStereoCamera:
    """Two cameras that take noisy images of the true scene.

    ``rig`` and ``camera_from_base`` (4, 4) have their true values. In the drawable of
    ``formation``, body 0 is the platform and body 1 the base. The further bodies are the obstacles,
    in the order of ``obstacle_names``. ``exposure`` is the exposure time, s. ``pattern_seed`` is
    the seed of the fixed pattern. The right camera exposes ``right_later`` s after the left camera,
    and each row of pixels is exposed ``row_time`` s after the row above it.
    """

    rig: StereoRig
    camera_from_base: Array
    formation: ImageFormation
    noise: CameraNoise
    obstacle_names: Sequence[str] = ()
    exposure: float = 0.0
    pattern_seed: int = 0
    right_later: float = 0.0
    row_time: float = 0.0

    def look(
        self,
        pose: Array,
        rng: np.random.Generator,
        obstacles: Mapping[str, Array] | None = None,
        quality: Quality | None = None,
        pose_rate: Array | None = None,
    ) -> "LiveImages":
        """Take one exposure of the platform, and of obstacles at base_from_body (4, 4) by name.

        ``pose`` (6,) is the pose in the middle of the left camera's exposure, and ``pose_rate``
        (6,) its time derivative, None at rest. Obstacles stand still, or are absent if not named.
        """
        rates = None if pose_rate is None else pose_rate[None]
        moments = self._moments(pose[None], rates, obstacles or {})[0]
        sweep = self._sweeps(pose[None], rates)[0]
        return LiveImages(self, moments, rng, quality or Quality(), sweep)

    def look_many(
        self,
        poses: Array,
        rngs: Sequence[np.random.Generator],
        obstacles: Mapping[str, Array],
        pose_rates: Array,
    ) -> "ManyLiveImages":
        """Take one exposure at each of N poses (N, 6), with rates ``pose_rates`` (N, 6).

        Each exposure is taken as in ``look`` and has its own noise.
        """
        moments = self._moments(poses, pose_rates, obstacles)
        return ManyLiveImages(self, moments, rngs, self._sweeps(poses, pose_rates))

    def moved(self, changes: Array) -> "VirtualStereoCamera":
        """Return the cameras after adding ``changes`` (24,) to the parameters of their rig.

        The fixed pattern of their pixels does not change.
        """
        camera = replace(self, rig=self.rig.moved(changes))
        camera.__dict__["patterns"] = self.patterns
        return camera

    def radiances(
        self,
        moments: Sequence[Moments],
        corners: Sequence[NDArray[np.int_]],
        size: int,
        supersampling: int,
        sweeps: Sequence[Array | None] | None = None,
    ) -> list[NDArray[np.float32]]:
        """Return the mean radiance (2, n, size, size) of windows over the moments of each exposure.

        For each exposure, the windows have first pixels ``corners`` (2, n, 2) in the left and the
        right image. ``sweeps`` is the result of ``row_sweeps``. The first moments of all exposures
        are drawn first, then the second ones, and so on, with no more memory than without motion.
        """
        swept_by = [None] * len(moments) if sweeps is None else sweeps
        light = self._drawn(
            [first for first, *_ in moments], corners, size, supersampling, swept_by
        )
        for k in range(1, max(map(len, moments))):
            moving = [n for n, own in enumerate(moments) if len(own) > k]
            drawn = self._drawn(
                [moments[n][k] for n in moving],
                [corners[n] for n in moving],
                size,
                supersampling,
                [swept_by[n] for n in moving],
            )
            for n, more in zip(moving, drawn, strict=True):
                light[n] += more
        for mean, own in zip(light, moments, strict=True):
            if len(own) > 1:
                mean /= np.float32(len(own))
        return light

    def _drawn(
        self,
        placed: Sequence[Sequence[Array]],
        corners: Sequence[NDArray[np.int_]],
        size: int,
        supersampling: int,
        sweeps: Sequence[Array | None],
    ) -> list[NDArray[np.float32]]:
        """Return the radiance (2, n, size, size) of windows at one moment of each exposure.

        Exposures are drawn together if their pixels are drawn directly. With a finer grid, they are
        drawn one by one, because many of them would not fit into the processor's caches.
        """
        sides = [
            Side(*side)
            for at, first in zip(placed, corners, strict=True)
            for side in zip(self.rig.cameras, at, first, strict=True)
        ]
        if any(sweep is not None for sweep in sweeps):
            return drawn_at_middle_rows(self.formation, sides, sweeps, size, supersampling)
        together = max(len(sides), 2) if self.formation.draws_pixels(self.rig.cameras) else 2
        windows = [
            window
            for start in range(0, len(sides), together)
            for window in self.formation.windows(
                sides[start : start + together], size, supersampling
            )
        ]
        return [np.stack(pair) for pair in zip(windows[::2], windows[1::2], strict=True)]

    def _sweeps(self, poses: Array, rates: Array | None) -> list[Array | None]:
        """Return the result of ``row_sweeps`` for poses (N, 6) that change at rates (N, 6)."""
        if self.row_time == 0.0 or rates is None:
            return [None] * len(poses)
        return row_sweeps(poses, rates, self.row_time, self._from_base)

    def whole_exposure(
        self,
        side: int,
        moments: Sequence[Array],
        supersampling: int,
        sweep: Array | None = None,
    ) -> NDArray[np.float32]:
        """Return the mean radiance (height, width) of one whole image over all moments.

        ``side`` is 0 for the left and 1 for the right camera. Each moment has the camera_from_body
        (b, 4, 4) of this camera. ``sweep`` (2, 4, 4) is an element of the result of ``row_sweeps``.
        """
        own = None if sweep is None else sweep[side]
        return whole_image(self.formation, self.rig.cameras[side], moments, supersampling, own)

    def centre_error_px(self, quality: Quality) -> float:
        """Return the error of a sticker's centre that drawing causes, px rms."""
        return self.formation.centre_error_px(self.rig.cameras, quality.supersampling)

    @cached_property
    def _from_base(self) -> list[Array]:
        return [move @ self.camera_from_base for move in self.rig.from_camera]

    @cached_property
    def patterns(self) -> Sequence[FixedPattern | None]:
        """Fixed patterns of the left and of the right camera; None without noise or differences."""
        prnu = self.noise.prnu
        dsnu = self.noise.dsnu
        if not (self.noise.enabled and (prnu > 0.0 or dsnu > 0.0)):
            return None, None
        rngs = [np.random.default_rng([self.pattern_seed, side]) for side in range(2)]
        shapes = [(camera.height, camera.width) for camera in self.rig.cameras]
        return [
            draw_pattern(shape, prnu, dsnu, rng) for shape, rng in zip(shapes, rngs, strict=True)
        ]

    def pattern_in(self, corners: NDArray[np.int_], size: int) -> FixedPattern | None:
        """Return the fixed pattern in windows of one size at ``corners`` (2, n, 2), or None."""
        cut = [
            p.windows(at, size)
            for p, at in zip(self.patterns, corners, strict=True)
            if p is not None
        ]
        return (
            FixedPattern(np.stack([c.sensitivity for c in cut]), np.stack([c.offset for c in cut]))
            if cut
            else None
        )

    def _moments(
        self, poses: Array, rates: Array | None, obstacles: Mapping[str, Array]
    ) -> list[Moments]:
        """Return the moments of N exposures at poses (N, 6) that change at rates (N, 6).

        Without rates, or with an exposure time of 0, each exposure has one moment.
        """
        parts = list(poses[:, None])
        change = np.zeros(poses.shape)
        if rates is not None:
            change = self.right_later * rates
            if self.exposure > 0.0:
                parts = sub_frame_poses(poses, rates, self.exposure, self._sticker_pixels)
        counts = [len(part) for part in parts]
        left = np.concatenate(parts)
        placed = self._placed(left, left + np.repeat(change, counts, axis=0), obstacles)
        return [
            placed[end - count : end] for count, end in zip(counts, np.cumsum(counts), strict=True)
        ]

    def _placed(
        self, left: Array, right: Array, obstacles: Mapping[str, Array]
    ) -> list[tuple[Array, Array]]:
        """Return camera_from_body (b, 4, 4) of all bodies for both cameras, for each of N moments.

        ``left`` and ``right`` (N, 6) are the platform's poses when each camera exposes.
        """
        # An obstacle without a transform is placed far below the scene.
        absent = rigid(np.eye(3), (0.0, 0.0, -1e3))
        still = np.stack(
            [np.eye(4), *(obstacles.get(name, absent) for name in self.obstacle_names)]
        )
        sides = []
        for camera, poses in zip(self._from_base, (left, right), strict=True):
            placed = np.empty((len(poses), 1 + len(still), 4, 4))
            placed[:, 0] = camera @ transforms_of(poses)
            placed[:, 1:] = camera @ still
            sides.append(list(placed))
        return list(zip(*sides, strict=True))

    def _sticker_pixels(self, poses: Array) -> Array:
        """Return pixels (2, N, n, 2) of the platform's stickers at poses (N, 6)."""
        return self.rig.project(
            apply_each(self.camera_from_base @ transforms_of(poses), self._sticker_places)
        )[0]

    @cached_property
    def _sticker_places(self) -> Array:
        """Positions (n, 3) of the platform's stickers, m, in its axes."""
        drawable = self.formation.drawable
        return np.array(
            [
                patch.discs[-1].centre
                for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
                if body == 0 and isinstance(patch, DiscStack)
            ]
        )


class LiveImages:
    """Images of one exposure. Only the windows that are read are drawn."""

    def __init__(
        self,
        camera: VirtualStereoCamera,
        moments: Moments,
        rng: np.random.Generator,
        quality: Quality,
        sweep: Array | None,
    ) -> None:
        self._camera = camera
        self._moments = moments
        self._rng = rng
        self._quality = quality
        self._sweep = sweep

    def full(self) -> StereoFrame:
        """Return both whole images of a single exposure, even if windows average several."""
        images = []
        for side, pattern in enumerate(self._camera.patterns):
            moments = [placed[side] for placed in self._moments]
            radiance = self._camera.whole_exposure(
                side, moments, self._quality.supersampling, self._sweep
            )
            images.append(self._camera.noise.expose(radiance, self._rng, pattern))
        return StereoFrame(*images)

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Return the grey values (2, n, size, size) of windows with first pixels ``corners``.

        The first pixels (2, n, 2) are (x, y). Each call draws new noise.
        """
        (radiance,) = self._camera.radiances(
            [self._moments], [corners], size, self._quality.supersampling, [self._sweep]
        )
        pattern = self._camera.pattern_in(corners, size)
        if self._quality.exposures == 1:
            return self._camera.noise.expose(radiance, self._rng, pattern)
        return self._camera.noise.mean_of_exposures(
            radiance, self._rng, self._quality.exposures, pattern
        )


class ManyLiveImages:
    """Images of several exposures, each with its own noise. Windows are drawn when read."""

    def __init__(
        self,
        camera: VirtualStereoCamera,
        moments: Sequence[Moments],
        rngs: Sequence[np.random.Generator],
        sweeps: Sequence[Array | None],
    ) -> None:
        self._camera = camera
        self._moments = moments
        self._rngs = rngs
        self._sweeps = sweeps

    def windows_of(
        self, exposures: NDArray[np.int_], corners: NDArray[np.int_], size: int
    ) -> Windows:
        """Return the grey values (2, n, size, size) of windows of several exposures.

        The windows have first pixels ``corners`` (2, n, 2) and belong to ``exposures`` (n,), which
        are in rising order.
        """
        camera = self._camera
        shown = np.unique(exposures)
        own = np.split(corners, np.searchsorted(exposures, shown[1:]), axis=1)
        drawn = camera.radiances(
            [self._moments[k] for k in shown],
            own,
            size,
            Quality().supersampling,
            [self._sweeps[k] for k in shown],
        )
        grey = [
            camera.noise.expose(light, self._rngs[k], camera.pattern_in(at, size))
            for k, light, at in zip(shown, drawn, own, strict=True)
        ]
        return np.concatenate(grey, axis=1, dtype=camera.noise.image_type)
