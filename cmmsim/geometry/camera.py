"""Pinhole camera with lens distortion.

Pixel (0, 0) is the centre of the top-left pixel; camera axes are x right, y down, z forward. Ideal pixels are those of
the same camera with a perfect lens: lines are straight there, and epipolar geometry and triangulation hold.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cmmsim.checks import finite_array
from cmmsim.errors import CmmError
from cmmsim.geometry.distortion import Distortion, NDArrayBool
from cmmsim.geometry.pose import Array


@dataclass(frozen=True)
class PinholeCamera:
    """Focal length and principal point in px, image size in px.

    focal_px is the focal length along x; aspect: the one along y divided by it; distortion of the lens.
    """

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width: int
    height: int
    aspect: float = 1.0
    distortion: Distortion = field(default_factory=Distortion)

    def __post_init__(self) -> None:
        figures = (self.focal_px, self.centre_x_px, self.centre_y_px, self.width, self.height, self.aspect)
        finite_array(figures, (6,), "a camera's focal length, principal point, size and aspect are finite numbers")
        if self.focal_px <= 0.0 or self.aspect <= 0.0 or self.width < 1 or self.height < 1:
            raise CmmError(f"camera needs a positive focal length, aspect and size, got {self}")

    @cached_property
    def focal_lengths(self) -> Array:
        """Focal lengths (2,) along x and y, px."""
        return _constant(self.focal_px, self.focal_px * self.aspect)

    @cached_property
    def centre(self) -> Array:
        """Principal point (2,), px."""
        return _constant(self.centre_x_px, self.centre_y_px)

    @property
    def matrix(self) -> Array:
        """Camera matrix K (3,3)."""
        return np.array(
            [
                [self.focal_px, 0.0, self.centre_x_px],
                [0.0, self.focal_px * self.aspect, self.centre_y_px],
                [0.0, 0.0, 1.0],
            ]
        )

    @cached_property
    def ideal(self) -> PinholeCamera:
        """The same camera with a perfect lens."""
        return self if self.distortion.is_zero else replace(self, distortion=Distortion())

    def project(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Pixels (..., 2) of points (..., 3) in camera axes, and whether each lies before the camera and inside."""
        depth = points[..., 2]
        ahead = depth > 1e-6
        scale = self.focal_lengths / np.where(ahead, depth, 1.0)[..., None]
        pixels = points[..., :2] * scale + self.centre
        if not self.distortion.is_zero:
            pixels, holds = self.distort(pixels)
            ahead &= holds
        return pixels, ahead & self.shows(pixels)

    def shows(self, pixels: Array) -> NDArrayBool:
        """Whether pixels (..., 2) lie inside the image."""
        return np.all((pixels > -0.5) & (pixels < (self.width - 0.5, self.height - 0.5)), axis=-1)

    def distort(self, ideal: Array) -> tuple[Array, NDArrayBool]:
        """Pixels (..., 2) of the image for ideal pixels (..., 2), and whether the distortion model holds there."""
        if self.distortion.is_zero:
            return ideal, np.ones(ideal.shape[:-1], dtype=bool)
        normalised = (ideal - self.centre) / self.focal_lengths
        return self.distortion.distort(normalised) * self.focal_lengths + self.centre, self.distortion.holds(normalised)

    def undistort(self, pixels: Array) -> tuple[Array, NDArrayBool]:
        """Ideal pixels (..., 2) for pixels (..., 2) of the image, and whether each has one.

        The values of those without one are finite and mean nothing.
        """
        if self.distortion.is_zero:
            return pixels, np.ones(pixels.shape[:-1], dtype=bool)
        normalised, found = self.distortion.undistort((pixels - self.centre) / self.focal_lengths)
        return normalised * self.focal_lengths + self.centre, found

    def distortion_jacobian(self, ideal: Array) -> Array:
        """Derivative (..., 2, 2) of the image's pixels by the ideal ones (..., 2)."""
        focal = self.focal_lengths
        return self.distortion.jacobian((ideal - self.centre) / focal) * focal[:, None] / focal


def _constant(*values: float) -> Array:
    array = np.array(values)
    array.setflags(write=False)
    return array
