"""Compiled kernels for the distortion of a lens, and its inverse.

Module ``lens_distortion`` states the formulas, which act on normalised image coordinates.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled

# Newton's method has converged if the distortion maps its result to within this of the given point,
# in each normalised coordinate.
CONVERGED = 1e-12
MOST_STEPS = 60


@compiled
def distort_point(
    x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple:
    """Return a distorted point x, y and its derivatives xx, xy, yy at an undistorted point (x, y).

    The matrix of derivatives is symmetric.
    """
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    growth = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    mixed = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
        y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed,
        radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled
def distort_points(lens: Array, points: Array, distorted: Array, slopes: Array) -> None:
    """Fill ``distorted`` (n, 2) with distorted points, and ``slopes`` (n, 2, 2) with derivatives.

    ``lens`` (5,) is k1, k2, p1, p2, k3, and ``points`` (n, 2) are undistorted.
    """
    for n in range(len(points)):
        x, y, xx, xy, yy = distort_point(
            points[n, 0], points[n, 1], lens[0], lens[1], lens[2], lens[3], lens[4]
        )
        distorted[n, 0] = x
        distorted[n, 1] = y
        slopes[n, 0, 0] = xx
        slopes[n, 0, 1] = slopes[n, 1, 0] = xy
        slopes[n, 1, 1] = yy


@compiled
def undistort_points(
    lens: Array, points: Array, reach: float, undistorted: Array, found: Array
) -> None:
    """Fill the undistorted points (n, 2) of distorted ``points`` (n, 2) by Newton's method.

    ``found`` (n,) is True if the method converged within the radius ``reach`` to a point where the
    image is not mirrored. Other points are finite but meaningless. ``lens`` (5,) is k1, k2, p1, p2,
    k3.
    """
    for n in range(len(points)):
        x = points[n, 0]
        y = points[n, 1]
        residual = np.inf
        determinant = 0.0
        for _ in range(MOST_STEPS + 1):
            radius = math.sqrt(x * x + y * y)
            if radius > reach:
                x *= reach / radius
                y *= reach / radius
            u, v, xx, xy, yy = distort_point(x, y, lens[0], lens[1], lens[2], lens[3], lens[4])
            residual_x = points[n, 0] - u
            residual_y = points[n, 1] - v
            residual = max(abs(residual_x), abs(residual_y))
            determinant = xx * yy - xy * xy
            if residual <= 0.1 * CONVERGED:
                break
            # Near the fold the determinant vanishes; the smallest divisor avoids infinite steps.
            divisor = determinant if abs(determinant) > 1e-6 else 1e-6
            x += min(max((yy * residual_x - xy * residual_y) / divisor, -1.0), 1.0)
            y += min(max((xx * residual_y - xy * residual_x) / divisor, -1.0), 1.0)
        undistorted[n, 0] = x
        undistorted[n, 1] = y
        found[n] = residual <= CONVERGED and determinant > 0.0
