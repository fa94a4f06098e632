"""Compiled kernels for the triangulation of points from their pixels in both images.

A point and its covariance follow from a weighted least-squares fit to the pixels, by Gauss-Newton.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, point_derivatives, project, transformed
from cmmsim.geometry.matrix_kernels import from_entries, inverse_entries

# Largest number of Gauss-Newton steps of a triangulation.
TRIANGULATION_STEPS = 6


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
