"""Pinhole camera. Pixel (0, 0) is the centre of the top-left pixel; camera axes are x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import CmmError
from .pose import Array


@dataclass(frozen=True)
class PinholeCamera:
    """Focal length and principal point in px, image size in px."""

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.focal_px <= 0.0 or self.width < 1 or self.height < 1:
            raise CmmError(f"camera needs a positive focal length and size, got {self}")

    @property
    def matrix(self) -> Array:
        """Camera matrix K (3,3)."""
        return np.array([[self.focal_px, 0.0, self.centre_x_px], [0.0, self.focal_px, self.centre_y_px],
                         [0.0, 0.0, 1.0]])

    def project(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Pixels (..., 2) of points (..., 3) in camera axes, and whether each lies before the camera and inside."""
        depth = points[..., 2]
        ahead = depth > 1e-6
        scale = self.focal_px / np.where(ahead, depth, 1.0)
        pixels = points[..., :2] * scale[..., None] + (self.centre_x_px, self.centre_y_px)
        inside = np.all((pixels > -0.5) & (pixels < (self.width - 0.5, self.height - 0.5)), axis=-1)
        return pixels, ahead & inside

    def projection_jacobian(self, points: Array) -> Array:
        """Derivative (..., 2, 3) of the pixel by the point (..., 3) in camera axes, px/m."""
        x, y, z = np.moveaxis(points, -1, 0)
        jacobian = np.zeros((*points.shape[:-1], 2, 3))
        jacobian[..., 0, 0] = jacobian[..., 1, 1] = self.focal_px / z
        jacobian[..., 0, 2] = -self.focal_px * x / z**2
        jacobian[..., 1, 2] = -self.focal_px * y / z**2
        return jacobian


NDArrayBool = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
