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
    pixel with respect to the point, and W the inverse of the covariance ``spread`` (2, 2) +
    ``line_variance`` I, px². J' W J is added to the six entries ``normal`` (6,), and J' W r to the
    right-hand side ``right`` (3,). ``move`` (4, 4) transforms the point into camera axes.
    """
    x, y, z = transformed(move, point)
    u, v, a, b, c, d = project(camera, x, y, z)
    r = pixel[0] - u
    s = pixel[1] - v
    xx = spread[0, 0] + line_variance
    xy = spread[0, 1]
    yy = spread[1, 1] + line_variance
    inverse_determinant = 1.0 / (xx * yy - xy * xy)
    inverse_depth = 1.0 / z
    w_xx = inverse_determinant * yy
    w_xy = -inverse_determinant * xy
    w_yy = inverse_determinant * xx
    f_x = inverse_depth * camera[0]
    f_y = inverse_depth * camera[1]
    t_x = inverse_depth * x
    t_y = inverse_depth * y
    weighted_r = w_xx * r + w_xy * s
    weighted_s = w_xy * r + w_yy * s
    first_0, first_1, first_2 = point_derivatives(move, a, b, f_x, f_y, t_x, t_y)
    second_0, second_1, second_2 = point_derivatives(move, c, d, f_x, f_y, t_x, t_y)
    right[0] += first_0 * weighted_r + second_0 * weighted_s
    right[1] += first_1 * weighted_r + second_1 * weighted_s
    right[2] += first_2 * weighted_r + second_2 * weighted_s
    w_first_0 = w_xx * first_0 + w_xy * second_0
    w_second_0 = w_xy * first_0 + w_yy * second_0
    w_first_1 = w_xx * first_1 + w_xy * second_1
    w_second_1 = w_xy * first_1 + w_yy * second_1
    w_first_2 = w_xx * first_2 + w_xy * second_2
    w_second_2 = w_xy * first_2 + w_yy * second_2
    normal[0] += w_first_0 * first_0 + w_second_0 * second_0
    normal[1] += w_first_0 * first_1 + w_second_0 * second_1
    normal[2] += w_first_0 * first_2 + w_second_0 * second_2
    normal[3] += w_first_1 * first_1 + w_second_1 * second_1
    normal[4] += w_first_1 * first_2 + w_second_1 * second_2
    normal[5] += w_first_2 * first_2 + w_second_2 * second_2
    return r * weighted_r + s * weighted_s


@compiled
def triangulate_point(
    cameras: Cameras, pixels: Array, spreads: Array, line_variance: float, step_tolerance: float,
    point: Array, scratch: Array,
) -> float:  # fmt: skip
    """Triangulate a point (3,) from two pixels (2, 2); return the squared distance of their rays.

    ``point`` contains a start value and is replaced by the result. ``spreads`` (2, 2, 2) are the
    covariances of the pixels. Their sum with ``line_variance`` px² on the diagonals gives the
    weights and the unit of the distance. The point's covariance is multiplied by the fraction of
    the pixels' noise in the mean of these sums. This is exact only if both covariances are the same
    multiple of the unit matrix. Gauss-Newton ends with a step below ``step_tolerance`` m, or after
    TRIANGULATION_STEPS steps. The first two rows of ``scratch`` (3, 6) are filled with the entries
    of the point's information matrix and of its covariance.
    """
    normal = scratch[0]
    inverse = scratch[1]
    rhs = scratch[2]
    gap = 0.0
    for _ in range(TRIANGULATION_STEPS):
        for k in range(6):
            normal[k] = 0.0
            rhs[k] = 0.0
        gap = 0.0
        for side in range(2):
            gap += add_image(
                cameras.intrinsics[side], cameras.extrinsics[side], point, pixels[side],
                spreads[side], line_variance, normal, rhs,
            )  # fmt: skip
        inverse_entries(normal, inverse)
        x = inverse[0] * rhs[0] + inverse[1] * rhs[1] + inverse[2] * rhs[2]
        y = inverse[1] * rhs[0] + inverse[3] * rhs[1] + inverse[4] * rhs[2]
        z = inverse[2] * rhs[0] + inverse[4] * rhs[1] + inverse[5] * rhs[2]
        gap -= x * rhs[0] + y * rhs[1] + z * rhs[2]
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

    A line in the left image passes through the image of the triangulated ``point`` (3,), in the
    direction from the left to the right camera. The distance is positive if the left pixel of
    ``pixels`` (2, 2) lies to the right of this line for an observer who looks along it, which is
    below a line that leads to the right.
    """
    move = cameras.extrinsics[0]
    camera = cameras.intrinsics[0]
    x, y, z = transformed(move, point)
    u, v, _, _, _, _ = project(camera, x, y, z)
    right = cameras.extrinsics[1]
    along_x = 0.0
    along_y = 0.0
    for i in range(3):
        # The right camera's centre, relative to the left one's, in axes that both share.
        centre = 0.0
        for j in range(3):
            centre += move[j, i] * move[j, 3] - right[j, i] * right[j, 3]
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

    ``points`` (n, 3) contain start values and are replaced. Fills covariances (n, 3, 3), squared
    distances ``gaps`` (n,) of the rays and their signed roots ``rays`` (n,). See
    ``triangulate_point`` for the other parameters.
    """
    scratch = np.empty((3, 6))
    for n in range(len(points)):
        gaps[n] = triangulate_point(
            cameras, pixels[n], spreads[n], line_variance, step_tolerance, points[n], scratch
        )  # fmt: skip
        rays[n] = signed_distance(cameras, pixels[n], points[n], gaps[n])
        from_entries(scratch[1], covariances[n])
