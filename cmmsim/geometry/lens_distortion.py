"""Lens distortion by the model of Brown and Conrady.

The five distortion coefficients have OpenCV's order and meaning. Distortion acts on normalised
image coordinates (x, y) = (X/Z, Y/Z). With s = x² + y²:

    x_d = x (1 + k1 s + k2 s² + k3 s³) + 2 p1 x y + p2 (s + 2 x²)
    y_d = y (1 + k1 s + k2 s² + k3 s³) + p1 (s + 2 y²) + 2 p2 x y

The model is valid up to the fold radius, at which the radial part stops growing, and only where the
determinant of the derivative is positive. Beyond the fold radius the image folds back onto itself.
Source: D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971).
``lens_distortion_kernels`` computes the distortion and its inverse.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

NDArrayBool = NDArray[np.bool_]
# A fold at a normalised radius beyond this is ignored.
FARTHEST_FOLD = 1e3


@dataclass(frozen=True)
class Distortion:
    """Radial coefficients k1, k2, k3 and tangential p1, p2; all are zero for a perfect lens.

    Raises CmmError if a coefficient is not finite.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(astuple(self)).all():
            raise CmmError(
                "distortion needs finite coefficients k1, k2, p1, p2, k3, got "
                f"{list(astuple(self))}"
            )

    @property
    def is_zero(self) -> bool:
        """True if all coefficients are zero."""
        return not (self.k1 or self.k2 or self.p1 or self.p2 or self.k3)

    @cached_property
    def fold_radius(self) -> float:
        """Undistorted radius at which the radial part stops growing; infinite if it never stops."""
        # Values of 1/s at which the derivative of the radial part is zero.
        roots = np.roots([1.0, 3.0 * self.k1, 5.0 * self.k2, 7.0 * self.k3])
        turning = roots[
            (np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 1.0 / FARTHEST_FOLD**2)
        ].real
        return float(1.0 / np.sqrt(turning.max())) if len(turning) else np.inf

    def distort(self, points: Array) -> Array:
        """Return the distorted points (..., 2) of undistorted points (..., 2)."""
        return self._distorted(points)[0]

    def jacobian(self, points: Array) -> Array:
        """Return the derivatives (..., 2, 2) of distorted points at undistorted points (..., 2)."""
        return self._distorted(points)[1]

    def _distorted(self, points: Array) -> tuple[Array, Array]:
        """Return the distorted points (..., 2), and their derivatives (..., 2, 2)."""
        # Imported late, because importing numba takes time.
        from cmmsim.geometry.lens_distortion_kernels import distort_points

        flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 2)
        distorted = np.empty_like(flat)
        derivatives = np.empty((len(flat), 2, 2))
        distort_points(np.array(astuple(self)), flat, distorted, derivatives)
        return distorted.reshape(points.shape), derivatives.reshape(*points.shape, 2)

    def holds(self, points: Array) -> NDArrayBool:
        """Return a mask (...) of the undistorted points (..., 2) at which the model is valid.

        The model is valid inside the fold radius if the determinant of the derivative is positive.
        """
        within = np.sum(points * points, axis=-1) < self.fold_radius**2
        return within & (np.linalg.det(self.jacobian(points)) > 0.0)

    def undistort(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Return the undistorted points (..., 2) of distorted points, and whether each was found.

        Newton's method searches inside the fold radius. A point was found if the method converged
        to 1e-12 in both coordinates, and the determinant of the derivative is positive there. The
        value of a point that was not found is finite but meaningless.
        """
        # Imported late, because importing numba takes time.
        from cmmsim.geometry.lens_distortion_kernels import undistort_points

        flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 2)
        undistorted = np.empty_like(flat)
        found = np.empty(len(flat), dtype=bool)
        reach = 0.999999 * self.fold_radius
        undistort_points(np.array(astuple(self)), flat, reach, undistorted, found)
        return undistorted.reshape(points.shape), found.reshape(points.shape[:-1])
