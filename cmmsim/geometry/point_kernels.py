"""Compiled: points seen by two cameras, by least squares in the pixels of their images."""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, project
from cmmsim.geometry.matrix_kernels import from_entries, inverse_entries

MOST_STEPS = 6


@compiled
def slope_by(
    move: Array, by_u: float, by_v: float, f_x: float, f_y: float, t_x: float, t_y: float
) -> tuple:
    """Return the slope of one coordinate of a pixel by a point, along three axes.

    by_u and by_v are its slopes by the ideal pixel; f_x and f_y focal lengths over depth; t_x and
    t_y the tangents of the line of sight.
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
def pull(
    camera: Array, move: Array, point: Array, pixel: Array, spread: Array, parted: float,
    normal: Array, right: Array,
) -> float:  # fmt: skip
    """Add what one image says of a point (3,) to its normal equations; return r' W r.

    r is the ``pixel`` (2,) less its expected place, J its slope, and W the inverse of ``spread``
    (2,2) + ``parted``. ``normal`` (6,) has the entries of J' W J, ``right`` (3,) is J' W r.
    """
    x = move[0, 0] * point[0] + move[0, 1] * point[1] + move[0, 2] * point[2] + move[0, 3]
    y = move[1, 0] * point[0] + move[1, 1] * point[1] + move[1, 2] * point[2] + move[1, 3]
    z = move[2, 0] * point[0] + move[2, 1] * point[1] + move[2, 2] * point[2] + move[2, 3]
    u, v, a, b, c, d = project(camera, x, y, z)
    r = pixel[0] - u
    s = pixel[1] - v
    xx = spread[0, 0] + parted
    xy = spread[0, 1]
    yy = spread[1, 1] + parted
    share = 1.0 / (xx * yy - xy * xy)
    near = 1.0 / z
    w_xx = share * yy
    w_xy = -share * xy
    w_yy = share * xx
    f_x = near * camera[0]
    f_y = near * camera[1]
    t_x = near * x
    t_y = near * y
    along = w_xx * r + w_xy * s
    down = w_xy * r + w_yy * s
    first_0, first_1, first_2 = slope_by(move, a, b, f_x, f_y, t_x, t_y)
    second_0, second_1, second_2 = slope_by(move, c, d, f_x, f_y, t_x, t_y)
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
def triangulate(
    cameras: Cameras, pixels: Array, spreads: Array, parted: float, settled: float,
    point: Array, scratch: Array,
) -> float:  # fmt: skip
    """Move a point (3,) from near to where two pixels (2,2) put it; return the gap of their rays.

    The gap is the squared distance in units of the noise. ``spreads`` (2,2,2) are covariances of
    the pixels; ``parted`` px² is added to them, but the covariance of the point is that of
    ``spreads`` alone. Steps of Gauss-Newton end below ``settled`` m. ``scratch`` (3,6) is filled
    with the entries of the point's information and of its covariance.
    """
    normal = scratch[0]
    inverse = scratch[1]
    right = scratch[2]
    gap = 0.0
    for _ in range(MOST_STEPS):
        for k in range(6):
            normal[k] = 0.0
            right[k] = 0.0
        gap = 0.0
        for side in range(2):
            gap += pull(
                cameras.figures[side], cameras.moves[side], point, pixels[side], spreads[side],
                parted, normal, right,
            )  # fmt: skip
        inverse_entries(normal, inverse)
        x = inverse[0] * right[0] + inverse[1] * right[1] + inverse[2] * right[2]
        y = inverse[1] * right[0] + inverse[3] * right[1] + inverse[4] * right[2]
        z = inverse[2] * right[0] + inverse[4] * right[1] + inverse[5] * right[2]
        gap -= x * right[0] + y * right[1] + z * right[2]
        point[0] += x
        point[1] += y
        point[2] += z
        if x * x + y * y + z * z < settled * settled:
            break
    trace = spreads[0, 0, 0] + spreads[0, 1, 1] + spreads[1, 0, 0] + spreads[1, 1, 1]
    share = 0.25 * trace / (0.25 * trace + parted)
    for k in range(6):
        normal[k] /= share
        inverse[k] *= share
    return gap


@compiled
def triangulate_all(
    cameras: Cameras, pixels: Array, spreads: Array, parted: float, settled: float,
    points: Array, covariances: Array, gaps: Array,
) -> None:  # fmt: skip
    """Triangulate n points: pixels (n,2,2), their covariances (n,2,2,2), points (n,3) from start.

    Fills covariances (n,3,3) and gaps (n,); see ``triangulate``.
    """
    scratch = np.empty((3, 6))
    for n in range(len(points)):
        gaps[n] = triangulate(
            cameras, pixels[n], spreads[n], parted, settled, points[n], scratch
        )  # fmt: skip
        from_entries(scratch[1], covariances[n])
