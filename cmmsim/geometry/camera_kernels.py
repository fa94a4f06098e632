"""Compiled kernels for the image of a point in a distorting camera, and for triangulation.

A camera is given by its nine intrinsics in the order of ``camera.INTRINSIC_NAMES``. Module
``camera`` states the formulas of the distortion, which acts on normalised image coordinates.
Triangulation is a least-squares fit to the pixels of both images.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.matrix_kernels import from_entries, inverse_entries

# Largest distance between a distorted point and the image of the undistorted point that is found
# for it, in normalised coordinates.
CONVERGED = 1e-12
MOST_STEPS = 60
# Largest number of Gauss-Newton steps of a triangulation.
TRIANGULATION_STEPS = 6


class Cameras(NamedTuple):
    """Two cameras with ``intrinsics`` (2, 9) and image sizes ``size`` (2, 2), px.

    ``extrinsics`` (2, 4, 4) transform points from their given axes into the axes of each camera.
    """

    intrinsics: Array
    size: Array
    extrinsics: Array


@compiled
def distort_point(
    x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple:
    """Return a distorted point x, y and its derivatives xx, xy, yy at an undistorted point.

    The matrix of derivatives is symmetric.
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
    """Fill the undistorted points (n, 2) of distorted points (n, 2) by Newton's method.

    ``found`` (n,) is True if an undistorted point exists within the radius ``reach`` and the image
    is not mirrored there. Other values are finite but meaningless.
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
            u, v, xx, xy, yy = distort_point(x, y, lens[0], lens[1], lens[2], lens[3], lens[4])
            gap_x = points[n, 0] - u
            gap_y = points[n, 1] - v
            gap = max(abs(gap_x), abs(gap_y))
            determinant = xx * yy - xy * xy
            if gap <= 0.1 * CONVERGED:
                break
            # Near the fold the determinant vanishes; this limit avoids infinite steps.
            steady = determinant if abs(determinant) > 1e-6 else 1e-6
            x += min(max((yy * gap_x - xy * gap_y) / steady, -1.0), 1.0)
            y += min(max((xx * gap_y - xy * gap_x) / steady, -1.0), 1.0)
        undistorted[n, 0] = x
        undistorted[n, 1] = y
        found[n] = gap <= CONVERGED and determinant > 0.0


@compiled
def project(camera: Array, x_m: float, y_m: float, depth: float) -> tuple:
    """Return the pixel u, v of a point in camera axes, and the derivatives of the distortion.

    The derivatives xx, xy, yx, yy of the pixel are with respect to the ideal pixel.
    """
    u, v, xx, xy, yy = distort_point(
        x_m / depth, y_m / depth, camera[4], camera[5], camera[6], camera[7], camera[8]
    )
    skewed = camera[0] / camera[1]
    return camera[0] * u + camera[2], camera[1] * v + camera[3], xx, xy * skewed, xy / skewed, yy


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Return True if a sticker at a point (3,) in camera axes faces the camera.

    The cosine between its normal and the direction to the camera must exceed ``grazing``.
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

    ``by_u`` and ``by_v`` are the derivatives of the pixel coordinate with respect to the ideal
    pixel. ``f_x`` and ``f_y`` are the focal lengths divided by the depth, and ``t_x`` and ``t_y``
    are the normalised image coordinates of the point.
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
def add_image(
    camera: Array, move: Array, point: Array, pixel: Array, spread: Array, line_variance: float,
    normal: Array, right: Array,
) -> float:  # fmt: skip
    """Add one image's contribution to the normal equations of a point (3,); return r' W r.

    r is the measured ``pixel`` (2,) minus the predicted pixel. J is the derivative of the predicted
    pixel with respect to the point, and W the inverse of ``spread`` (2, 2) + ``line_variance`` I.
    J' W J is added to the six entries ``normal`` (6,), and J' W r to ``right`` (3,).
    """
    x, y, z = transformed(move, point)
    u, v, a, b, c, d = project(camera, x, y, z)
    r = pixel[0] - u
    s = pixel[1] - v
    xx = spread[0, 0] + line_variance
    xy = spread[0, 1]
    yy = spread[1, 1] + line_variance
    inverse_determinant = 1.0 / (xx * yy - xy * xy)
    near = 1.0 / z
    w_xx = inverse_determinant * yy
    w_xy = -inverse_determinant * xy
    w_yy = inverse_determinant * xx
    f_x = near * camera[0]
    f_y = near * camera[1]
    t_x = near * x
    t_y = near * y
    along = w_xx * r + w_xy * s
    down = w_xy * r + w_yy * s
    first_0, first_1, first_2 = point_derivatives(move, a, b, f_x, f_y, t_x, t_y)
    second_0, second_1, second_2 = point_derivatives(move, c, d, f_x, f_y, t_x, t_y)
    right[0] += first_0 * along + second_0 * down
    right[1] += first_1 * along + second_1 * down
    right[2] += first_2 * along + second_2 * down
    pushed_0 = w_xx * first_0 + w_xy * second_0
    pulled_0 = w_xy * first_0 + w_yy * second_0
    pushed_1 = w_xx * first_1 + w_xy * second_1
    pulled_1 = w_xy * first_1 + w_yy * second_1
    pushed_2 = w_xx * first_2 + w_xy * second_2
    pulled_2 = w_xy * first_2 + w_yy * second_2
    normal[0] += pushed_0 * first_0 + pulled_0 * second_0
    normal[1] += pushed_0 * first_1 + pulled_0 * second_1
    normal[2] += pushed_0 * first_2 + pulled_0 * second_2
    normal[3] += pushed_1 * first_1 + pulled_1 * second_1
    normal[4] += pushed_1 * first_2 + pulled_1 * second_2
    normal[5] += pushed_2 * first_2 + pulled_2 * second_2
    return r * along + s * down


@compiled
def triangulate_point(
    cameras: Cameras, pixels: Array, spreads: Array, line_variance: float, step_tolerance: float,
    point: Array, scratch: Array,
) -> float:  # fmt: skip
    """Triangulate a point (3,) from two pixels (2, 2); return the gap of their rays.

    ``point`` contains a start value and is replaced by the result. The gap is the squared distance
    of the rays in units of the noise. ``spreads`` (2, 2, 2) are the covariances of the pixels.
    ``line_variance`` px² is added to them for the weights and the gap, but not for the covariance
    of the point. Gauss-Newton ends with a step below ``step_tolerance`` m. The first two rows of
    ``scratch`` (3, 6) are filled with the entries of the point's information matrix and of its
    covariance.
    """
    normal = scratch[0]
    inverse = scratch[1]
    right = scratch[2]
    gap = 0.0
    for _ in range(TRIANGULATION_STEPS):
        for k in range(6):
            normal[k] = 0.0
            right[k] = 0.0
        gap = 0.0
        for side in range(2):
            gap += add_image(
                cameras.intrinsics[side], cameras.extrinsics[side], point, pixels[side],
                spreads[side], line_variance, normal, right,
            )  # fmt: skip
        inverse_entries(normal, inverse)
        x = inverse[0] * right[0] + inverse[1] * right[1] + inverse[2] * right[2]
        y = inverse[1] * right[0] + inverse[3] * right[1] + inverse[4] * right[2]
        z = inverse[2] * right[0] + inverse[4] * right[1] + inverse[5] * right[2]
        gap -= x * right[0] + y * right[1] + z * right[2]
        point[0] += x
        point[1] += y
        point[2] += z
        if x * x + y * y + z * z < step_tolerance * step_tolerance:
            break
    # the weights include errors of the rig, but the stated covariance is that of the noise alone
    trace = spreads[0, 0, 0] + spreads[0, 1, 1] + spreads[1, 0, 0] + spreads[1, 1, 1]
    noise_fraction = 0.25 * trace / (0.25 * trace + line_variance)
    for k in range(6):
        normal[k] /= noise_fraction
        inverse[k] *= noise_fraction
    return gap


@compiled
def signed_distance(cameras: Cameras, pixels: Array, point: Array, gap: float) -> float:
    """Return the signed distance of two rays in standard deviations, from its square ``gap``.

    The distance is positive if the left pixel of ``pixels`` (2, 2) lies on a fixed side of a line
    in the left image. This line passes through the image of the triangulated ``point`` (3,), in the
    direction from the left to the right camera.
    """
    move = cameras.extrinsics[0]
    camera = cameras.intrinsics[0]
    x, y, z = transformed(move, point)
    u, v, _, _, _, _ = project(camera, x, y, z)
    other = cameras.extrinsics[1]
    along_x = 0.0
    along_y = 0.0
    for i in range(3):
        # The right camera's centre, relative to the left one's, in axes that both share.
        centre = 0.0
        for j in range(3):
            centre += move[j, i] * move[j, 3] - other[j, i] * other[j, 3]
        along_x += move[0, i] * centre
        along_y += move[1, i] * centre
    across = along_x * (pixels[0, 1] - v) - along_y * (pixels[0, 0] - u)
    return math.copysign(math.sqrt(max(gap, 0.0)), across)


@compiled
def triangulate_all(
    cameras: Cameras, pixels: Array, spreads: Array, line_variance: float, step_tolerance: float,
    points: Array, covariances: Array, gaps: Array, rays: Array,
) -> None:  # fmt: skip
    """Triangulate n points from pixels (n, 2, 2) with covariances ``spreads`` (n, 2, 2, 2).

    ``points`` (n, 3) contain start values and are replaced. Fills covariances (n, 3, 3), gaps (n,)
    and their signed roots ``rays`` (n,). See ``triangulate_point`` for the other parameters.
    """
    scratch = np.empty((3, 6))
    for n in range(len(points)):
        gaps[n] = triangulate_point(
            cameras, pixels[n], spreads[n], line_variance, step_tolerance, points[n], scratch
        )  # fmt: skip
        rays[n] = signed_distance(cameras, pixels[n], points[n], gaps[n])
        from_entries(scratch[1], covariances[n])
