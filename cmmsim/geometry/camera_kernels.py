"""Compiled kernels for the image of a point in a distorting camera.

A camera is given by its nine intrinsics in the order of ``camera.INTRINSIC_NAMES``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.lens_distortion_kernels import distort_point


class Cameras(NamedTuple):
    """Left and right camera, with ``intrinsics`` (2, 9) and image sizes ``size`` (2, 2), px.

    A size is (width, height). ``extrinsics`` (2, 4, 4) are the transforms into the axes of each
    camera from the axes in which points are given.
    """

    intrinsics: Array
    size: Array
    extrinsics: Array


@compiled
def project(camera: Array, x_m: float, y_m: float, depth: float) -> tuple:
    """Return the pixel u, v of a point in camera axes, and the derivatives of the distortion.

    The derivatives xx, xy, yx, yy of the pixel are with respect to the ideal pixel; xy is du / dy.
    The point must not have the depth 0. Whether the camera sees it is not tested.
    """
    u, v, xx, xy, yy = distort_point(
        x_m / depth, y_m / depth, camera[4], camera[5], camera[6], camera[7], camera[8]
    )
    ratio = camera[0] / camera[1]
    return camera[0] * u + camera[2], camera[1] * v + camera[3], xx, xy * ratio, xy / ratio, yy


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Return True if a sticker at ``point`` (3,) lies in front of the camera and faces it.

    The cosine between its ``normal`` (3,) and the direction to the camera must exceed ``grazing``.
    Point and normal are in camera axes.
    """
    dot = 0.0
    squared = 0.0
    for i in range(3):
        dot -= point[i] * normal[i]
        squared += point[i] * point[i]
    return point[2] > 1e-6 and dot > grazing * math.sqrt(squared)


@compiled
def length_of(x: float, y: float) -> float:
    """Return the length of a vector, faster than ``math.hypot``, which guards against overflow."""
    return math.sqrt(x * x + y * y)


@compiled
def light_at(camera: Array, size: Array, u: float, v: float, vignetting: float) -> float:
    """Return the relative illumination of pixel (u, v) in an image of size (width, height)."""
    if vignetting == 0.0:
        return 1.0
    x = camera[2]
    y = camera[3]
    # corner of the image's outer edge that is farthest from the principal point
    farthest_x = max(x + 0.5, size[0] - 0.5 - x)
    farthest_y = max(y + 0.5, size[1] - 0.5 - y)
    distance_ratio = ((u - x) ** 2 + (v - y) ** 2) / (farthest_x**2 + farthest_y**2)
    return max(1.0 - vignetting * distance_ratio, 0.0)


@compiled
def point_derivatives(
    move: Array, by_u: float, by_v: float, f_x: float, f_y: float, t_x: float, t_y: float
) -> tuple:
    """Return the derivatives of one pixel coordinate with respect to the coordinates of a point.

    ``move`` (4, 4) transforms the point into camera axes. ``by_u`` and ``by_v`` are the derivatives
    of the pixel coordinate with respect to the ideal pixel. ``f_x`` and ``f_y`` are the focal
    lengths divided by the depth, and ``t_x`` and ``t_y`` the normalised image coordinates.
    """
    in_x = by_u * f_x
    in_y = by_v * f_y
    in_z = -in_x * t_x - in_y * t_y
    return (
        in_x * move[0, 0] + in_y * move[1, 0] + in_z * move[2, 0],
        in_x * move[0, 1] + in_y * move[1, 1] + in_z * move[2, 1],
        in_x * move[0, 2] + in_y * move[1, 2] + in_z * move[2, 2],
    )


@compiled
def transformed(move: Array, point: Array) -> tuple:
    """Return the three coordinates of a point (3,) after a transform (4, 4)."""
    return (
        move[0, 0] * point[0] + move[0, 1] * point[1] + move[0, 2] * point[2] + move[0, 3],
        move[1, 0] * point[0] + move[1, 1] * point[1] + move[1, 2] * point[2] + move[1, 3],
        move[2, 0] * point[0] + move[2, 1] * point[1] + move[2, 2] * point[2] + move[2, 3],
    )


@compiled
def pose_slopes(camera: Array, move: Array, point: Array, arm: Array, slopes: Array) -> tuple:
    """Fill the derivatives (2, 6) of a point's pixel with respect to the small error of a pose.

    ``move`` (4, 4) transforms the ``point`` (3,) into camera axes. ``arm`` (3,) is the point
    relative to the origin of the pose's body, in the same axes as the point. Return the pixel.
    """
    x, y, z = transformed(move, point)
    u, v, a, b, c, d = project(camera, x, y, z)
    f_x = camera[0] / z
    f_y = camera[1] / z
    slopes[0, :3] = point_derivatives(move, a, b, f_x, f_y, x / z, y / z)
    slopes[1, :3] = point_derivatives(move, c, d, f_x, f_y, x / z, y / z)
    for i in range(2):
        slopes[i, 3] = slopes[i, 2] * arm[1] - slopes[i, 1] * arm[2]
        slopes[i, 4] = slopes[i, 0] * arm[2] - slopes[i, 2] * arm[0]
        slopes[i, 5] = slopes[i, 1] * arm[0] - slopes[i, 0] * arm[1]
    return u, v


@compiled
def weigh(slopes: Array, spread: Array, weight: Array, weighted: Array) -> None:
    """Fill the ``weight`` (2, 2) of a pixel, and its product (6, 2) with the slopes (2, 6).

    The weight is the inverse of the pixel's covariance ``spread`` (2, 2).
    """
    determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0]
    weight[0, 0] = spread[1, 1] / determinant
    weight[0, 1] = weight[1, 0] = -spread[0, 1] / determinant
    weight[1, 1] = spread[0, 0] / determinant
    for i in range(6):
        for j in range(2):
            weighted[i, j] = slopes[0, i] * weight[0, j] + slopes[1, i] * weight[1, j]
