"""The two virtual cameras: they look at the true scene and hand out noisy grey values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .images import StereoFrame, Windows
from .noise import CameraNoise
from .pose import Array, pose_to_transform
from .renderers import Renderer
from .stereo_rig import StereoRig
from .views import Drawable, View

SUPERSAMPLING = 6
PASTED_SIZE = 24  # px side of the finely drawn window around each bright spot of a whole image
BRIGHT = 0.4  # radiance above which a spot of a whole image is drawn finely


@dataclass(frozen=True)
class Quality:
    """How windows are made: supersampling per pixel and axis, and the number of exposures that are averaged."""

    supersampling: int = SUPERSAMPLING
    exposures: int = 1


class VirtualStereoCamera:
    """The true rig, its true place in the base frame, and what stands before it.

    Parameters: rig; camera_from_base (4,4); drawable whose body 0 is the platform and body 1 the base, the others
    being ``obstacle_names`` in order; noise; renderer; background radiance.
    """

    def __init__(self, rig: StereoRig, camera_from_base: Array, drawable: Drawable, noise: CameraNoise,
                 renderer: Renderer, obstacle_names: Sequence[str] = (), background: float = 0.0) -> None:
        self._rig, self._noise, self._renderer, self._background = rig, noise, renderer, background
        self._drawable, self._obstacle_names = drawable, tuple(obstacle_names)
        self._from_base = [move @ camera_from_base for move in rig.from_camera]

    def look(self, pose: Array, rng: np.random.Generator, obstacles: Mapping[str, Array] | None = None,
             quality: Quality | None = None) -> LiveImages:
        """One exposure of the platform at ``pose`` (6,) and of the obstacles at base_from_body (4,4) each."""
        obstacles = obstacles or {}
        absent = np.diag([1.0, 1.0, 1.0, 1.0])
        absent[2, 3] = -1e3  # an obstacle without a place stands far behind both cameras
        places = [pose_to_transform(pose), np.eye(4)]
        placed = [np.stack([c @ p for p in places] + [c @ obstacles[n] if n in obstacles else absent
                                                      for n in self._obstacle_names]) for c in self._from_base]
        return LiveImages(self, placed, rng, quality or Quality())

    def radiance(self, placed: Sequence[Array], corners: NDArray[np.int_], size: int,
                 supersampling: int) -> NDArray[np.float32]:
        """Radiance (2, n, size, size) of windows at ``corners`` (2, n, 2) in the left and right image."""
        views = [View(camera, bodies, (int(x), int(y)), (size, size))
                 for camera, bodies, side in zip(self._rig.cameras, placed, corners, strict=True) for x, y in side]
        return self._renderer.draw(self._drawable, views, supersampling, self._background).reshape(2, -1, size, size)

    def whole_radiance(self, side: int, bodies: Array, supersampling: int) -> NDArray[np.float32]:
        """Radiance (height, width) of one whole image, its bright spots drawn as finely as windows are."""
        camera = self._rig.cameras[side]
        image = self._renderer.draw(self._drawable, [View(camera, bodies, (0, 0), (camera.width, camera.height))], 1,
                               self._background)[0]
        spots = cv2.connectedComponentsWithStats((image > BRIGHT).astype(np.uint8))[3][1:]
        spots = spots[np.isfinite(spots).all(axis=1)]
        if len(spots):
            highest = np.array([camera.width, camera.height]) - PASTED_SIZE
            corners = np.clip(np.rint(spots).astype(int) - PASTED_SIZE // 2, 0, highest)
            views = [View(camera, bodies, (int(x), int(y)), (PASTED_SIZE, PASTED_SIZE)) for x, y in corners]
            fine = self._renderer.draw(self._drawable, views, supersampling, self._background)
            for (x, y), window in zip(corners, fine, strict=True):
                image[y:y + PASTED_SIZE, x:x + PASTED_SIZE] = window
        return image

    def centre_error_px(self, quality: Quality) -> float:
        """What drawing leaves in a sticker's centre, px rms."""
        return self._renderer.centre_error_px(quality.supersampling)

    @property
    def noise(self) -> CameraNoise:
        """The cameras' noise figures."""
        return self._noise


class LiveImages:
    """One exposure, drawn as far as it is read."""

    def __init__(self, camera: VirtualStereoCamera, placed: Sequence[Array], rng: np.random.Generator,
                 quality: Quality) -> None:
        self._camera, self._placed, self._rng, self._quality = camera, placed, rng, quality

    def full(self) -> StereoFrame:
        """Both whole images."""
        return StereoFrame(*(self._camera.noise.expose(
            self._camera.whole_radiance(k, bodies, self._quality.supersampling), self._rng)
            for k, bodies in enumerate(self._placed)))

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x, y)."""
        radiance = self._camera.radiance(self._placed, corners, size, self._quality.supersampling)
        if self._quality.exposures == 1:
            return self._camera.noise.expose(radiance, self._rng)
        return self._camera.noise.mean_of_exposures(radiance, self._rng, self._quality.exposures)
