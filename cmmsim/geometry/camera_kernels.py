"""Compiled: the image of a point in a camera with a lens, and the light that reaches it.

A camera is given by its nine intrinsics in the order of ``camera.INTRINSIC_NAMES``. The lens bends
normalised image coordinates; ``camera`` has the formulas.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled

CONVERGED = (
    1e-12  # largest distance, in normalised coordinates, of a point from its inverse's image
)
MOST_STEPS = 60


class Cameras(NamedTuple):
    """Two cameras: ``figures`` (2,9) are their intrinsics and ``size`` (2,2) their images, px.

    ``moves`` (2,4,4) lead into their axes, from those in which points are given.
    """

    figures: Array
    size: Array
    moves: Array


@compiled
def bend(x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple:
    """Return a distorted point x, y and its slopes xx, xy, yy by the undistorted one (x, y).

    The slope of x by y equals that of y by x.
    """
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    growth = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    across = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
        y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        across,
        radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled
def bend_all(lens: Array, points: Array, bent: Array, slopes: Array) -> None:
    """Fill distorted points (n,2) and their slopes (n,2,2) by the undistorted points (n,2).

    The lens (5,) is k1, k2, p1, p2, k3.
    """
    for n in range(len(points)):
        x, y, xx, xy, yy = bend(
            points[n, 0], points[n, 1], lens[0], lens[1], lens[2], lens[3], lens[4]
        )
        bent[n, 0] = x
        bent[n, 1] = y
        slopes[n, 0, 0] = xx
        slopes[n, 0, 1] = slopes[n, 1, 0] = xy
        slopes[n, 1, 1] = yy


@compiled
def straighten_all(lens: Array, points: Array, reach: float, straight: Array, found: Array) -> None:
    """Fill the undistorted points (n,2) of distorted ones (n,2) by Newton's method.

    ``found`` (n,) says which have one within the radius ``reach`` at which the image is not turned
    over. The values of the others are finite and mean nothing.
    """
    for n in range(len(points)):
        x = points[n, 0]
        y = points[n, 1]
        gap = np.inf
        determinant = 0.0
        for _ in range(MOST_STEPS + 1):
            radius = math.sqrt(x * x + y * y)
            if radius > reach:
                x *= reach / radius
                y *= reach / radius
            u, v, xx, xy, yy = bend(x, y, lens[0], lens[1], lens[2], lens[3], lens[4])
            gap_x = points[n, 0] - u
            gap_y = points[n, 1] - v
            gap = max(abs(gap_x), abs(gap_y))
            determinant = xx * yy - xy * xy
            if gap <= 0.1 * CONVERGED:
                break
            steady = determinant if abs(determinant) > 1e-6 else 1e-6
            x += min(max((yy * gap_x - xy * gap_y) / steady, -1.0), 1.0)
            y += min(max((xx * gap_y - xy * gap_x) / steady, -1.0), 1.0)
        straight[n, 0] = x
        straight[n, 1] = y
        found[n] = gap <= CONVERGED and determinant > 0.0


@compiled
def project(camera: Array, x_m: float, y_m: float, depth: float) -> tuple:
    """Return the pixel u, v of a point in camera axes, and the slopes of the image there.

    The slopes xx, xy, yx, yy are those by the ideal pixel of a perfect lens.
    """
    u, v, xx, xy, yy = bend(
        x_m / depth, y_m / depth, camera[4], camera[5], camera[6], camera[7], camera[8]
    )
    skewed = camera[0] / camera[1]
    return camera[0] * u + camera[2], camera[1] * v + camera[3], xx, xy * skewed, xy / skewed, yy


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Tell whether a sticker at a point (3,) in camera axes is turned towards the camera.

    The cosine between its normal and the view must exceed ``grazing``.
    """
    dot = 0.0
    squared = 0.0
    for i in range(3):
        dot -= point[i] * normal[i]
        squared += point[i] * point[i]
    return point[2] > 1e-6 and dot > grazing * math.sqrt(squared)


@compiled
def length_of(x: float, y: float) -> float:
    """Return the length of a vector; ``math.hypot`` minds overflow and takes much longer."""
    return math.sqrt(x * x + y * y)


@compiled
def light_at(camera: Array, size: Array, u: float, v: float, vignetting: float) -> float:
    """Return the relative illumination of a pixel of a camera with an image size (2,)."""
    if vignetting == 0.0:
        return 1.0
    x = camera[2]
    y = camera[3]
    farthest_x = max(x + 0.5, size[0] - 0.5 - x)
    farthest_y = max(y + 0.5, size[1] - 0.5 - y)
    share = ((u - x) ** 2 + (v - y) ** 2) / (farthest_x**2 + farthest_y**2)
    return max(1.0 - vignetting * share, 0.0)
