"""What a lens does to light beside distortion: it spreads each point, and darkens towards the corners."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array

PSF_REACH = 5.0  # standard deviations after which the point spread is cut off


@dataclass(frozen=True)
class Optics:
    """psf_px: standard deviation of the Gaussian point spread, px of the image.

    vignetting: share of the light that is missing in the corner farthest from the principal point; the loss grows with
    the square of the distance from there. Both zero: the image of a pinhole.
    """

    psf_px: float = 0.0
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        if not (self.psf_px >= 0.0 and 0.0 <= self.vignetting < 1.0):
            raise CmmError(f"optics need psf_px >= 0 and vignetting from 0 to below 1, got {self}")

    @property
    def margin_px(self) -> int:
        """How far, in whole px, light from outside of a window reaches into it."""
        return ceil(PSF_REACH * self.psf_px)

    def illumination(self, camera: PinholeCamera, pixels: Array) -> Array:
        """Relative illumination (...) of pixels (..., 2) of the image, 1 at the principal point, 0 at the least."""
        corners = np.array([[x, y] for x in (-0.5, camera.width - 0.5) for y in (-0.5, camera.height - 0.5)])
        farthest = np.sum((corners - camera.centre) ** 2, axis=1).max()
        return np.maximum(1.0 - self.vignetting / farthest * np.sum((pixels - camera.centre) ** 2, axis=-1), 0.0)

    def window_illumination(self, camera: PinholeCamera, corners: NDArray[np.int_], size: int) -> Array:
        """Relative illumination (k, size, size) of windows with first pixels ``corners`` (k, 2)."""
        ticks = np.arange(size)
        x, y = corners[:, 0, None, None] + ticks, corners[:, 1, None, None] + ticks[:, None]
        return self.illumination(camera, np.stack(np.broadcast_arrays(x, y), axis=-1))


@lru_cache(maxsize=32)
def pixel_response(psf_px: float, size: int, margin: int, sub_pixels: int) -> NDArray[np.float32]:
    """Weights (size, (size + 2 margin) sub_pixels) float32 with which drawn sub-pixels count in each pixel of a row.

    The mean over a pixel of a Gaussian of ``psf_px``: the drawn sub-pixels, means over their own width, make up the
    exact mean over a pixel wherever the Gaussian puts it.
    """
    total = (size + 2 * margin) * sub_pixels
    into_pixels = np.kron(np.eye(size, size + 2 * margin, margin), np.full(sub_pixels, 1.0 / sub_pixels))
    if psf_px > 0.0:
        gap = np.subtract.outer(np.arange(total), np.arange(total))
        spread = np.exp(-0.5 * (gap / (psf_px * sub_pixels)) ** 2) * (np.abs(gap) <= margin * sub_pixels)
        into_pixels = into_pixels @ (spread / spread[total // 2].sum())
    weights = into_pixels.astype(np.float32)
    weights.setflags(write=False)
    return weights
