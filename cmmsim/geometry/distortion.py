"""Lens distortion of Brown and Conrady, in OpenCV's order and meaning of the five coefficients.

Acts on normalised image coordinates (x, y) = (X/Z, Y/Z) of a camera. With s = x² + y²:

    x_d = x (1 + k1 s + k2 s² + k3 s³) + 2 p1 x y + p2 (s + 2 x²)
    y_d = y (1 + k1 s + k2 s² + k3 s³) + p1 (s + 2 y²) + 2 p2 x y

The model holds up to the radius where the radial part stops growing: beyond it the image folds back onto itself.
Source: D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import cached_property

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

NDArrayBool = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
CONVERGED = 1e-12  # largest distance, in normalised coordinates, between a point and the image of its inverse
MOST_STEPS = 60
FARTHEST_FOLD = 1e3  # focal lengths: a fold beyond is none


@dataclass(frozen=True)
class Distortion:
    """Radial k1, k2, k3 and tangential p1, p2; all zero is a perfect lens."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(astuple(self)).all():
            raise CmmError(f"distortion needs finite coefficients k1, k2, p1, p2, k3, got {list(astuple(self))}")

    @property
    def is_zero(self) -> bool:
        """Whether this lens moves nothing."""
        return not (self.k1 or self.k2 or self.p1 or self.p2 or self.k3)

    @cached_property
    def fold_radius(self) -> float:
        """Undistorted radius at which the radial part stops growing; infinite where it never does."""
        roots = np.roots([1.0, 3.0 * self.k1, 5.0 * self.k2, 7.0 * self.k3])  # of the slope, in 1/s
        turning = roots[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 1.0 / FARTHEST_FOLD**2)].real
        return float(1.0 / np.sqrt(turning.max())) if len(turning) else np.inf

    def distort(self, points: Array) -> Array:
        """Distorted points (..., 2) of undistorted ones (..., 2)."""
        x, y = points[..., 0], points[..., 1]
        s = x * x + y * y
        radial = 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3))
        return np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (s + 2.0 * x * x),
                y * radial + self.p1 * (s + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def jacobian(self, points: Array) -> Array:
        """Derivative (..., 2, 2) of the distorted by the undistorted points (..., 2)."""
        x, y = points[..., 0], points[..., 1]
        s = x * x + y * y
        radial = 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3))
        growth = 2.0 * (self.k1 + s * (2.0 * self.k2 + s * 3.0 * self.k3))
        across = growth * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        along_x = radial + growth * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        along_y = radial + growth * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        return np.stack([along_x, across, across, along_y], axis=-1).reshape(*points.shape[:-1], 2, 2)

    def holds(self, points: Array) -> NDArrayBool:
        """Whether the model is one-to-one at undistorted points (..., 2): within the fold and not turned over."""
        within = np.sum(points * points, axis=-1) < self.fold_radius**2
        return within & (np.linalg.det(self.jacobian(points)) > 0.0)

    def undistort(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Undistorted points (..., 2) of distorted ones (..., 2), and whether each was found.

        Newton's method to 1e-12. A point that no undistorted one within the fold reaches is not found; its value is
        finite and means nothing.
        """
        found = np.array(points, dtype=float)
        reach = 0.999999 * self.fold_radius
        for _ in range(MOST_STEPS):
            found = _drawn_in(found, reach)
            gap = points - self.distort(found)
            if np.abs(gap).max(initial=0.0) <= 0.1 * CONVERGED:
                break
            jacobian = self.jacobian(found)
            determinant = np.linalg.det(jacobian)
            steady = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
            step = np.stack(
                [
                    jacobian[..., 1, 1] * gap[..., 0] - jacobian[..., 0, 1] * gap[..., 1],
                    jacobian[..., 0, 0] * gap[..., 1] - jacobian[..., 1, 0] * gap[..., 0],
                ],
                axis=-1,
            )
            found = found + np.clip(step / steady[..., None], -1.0, 1.0)
        found = _drawn_in(found, reach)
        return found, (np.abs(points - self.distort(found)).max(axis=-1) <= CONVERGED) & self.holds(found)


def _drawn_in(points: Array, reach: float) -> Array:
    """Points (..., 2) with those beyond the radius ``reach`` drawn back onto it."""
    if not np.isfinite(reach):
        return points
    radius = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * np.minimum(1.0, reach / np.maximum(radius, reach))
