"""Compiled: stickers that two cameras found, triangulated and laid onto their taught places.

All is linear about what is expected: a sticker is found (sum J' W J)^-1 sum J' W r from there, with the slope J of its
pixels, their difference r from what is expected, and its inverse covariance W; the platform by the same least squares
over the stickers. Where r is long, the slopes are taken anew at what was found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.geometry.point_kernels import factor, inverse_of, invert_factored, left_noise, solve_factored
from cmmsim.statistical.camera_kernels import project

LONG_PX = 0.2  # difference between found and expected pixels beyond which slopes are taken anew
MOST_STEPS = 4


class Belief(NamedTuple):
    """What stickers must keep to be believed, as the estimator has it: squared differences of one from the others and
    of all from noise, and their fewest number; totals (f,): of squared residuals by their freedom, beyond which they
    are larger than noise."""

    largest_misfit: float
    largest_excess: float
    fewest: int
    totals: Array


class Frame(NamedTuple):
    """What one frame holds of n stickers: seen (n,) whether found in both images, and used (n,) whether believed;
    pixels (2,n,2), their covariances (2,n,2,2) px², and variances (n,) of a coordinate in the mean of both images;
    points (n,3) m in the camera frame, informations and covariances (n,3,3) of them, found (n,3): points less where
    they are expected, arms (n,3) from the platform's origin; longest (1,) px of a sticker's way during the exposure."""

    seen: Array
    used: Array
    pixels: Array
    spreads: Array
    variances: Array
    points: Array
    informations: Array
    covariances: Array
    found: Array
    arms: Array
    longest: Array


@compiled
def slope_by(move: Array, by_u: float, by_v: float, f_x: float, f_y: float, t_x: float, t_y: float) -> tuple:
    """Slope of one coordinate of a pixel by a point in the camera frame: by_u and by_v by the ideal pixels, which go
    with f_x and f_y, focal length over depth, and t_x and t_y, the tangents of the line of sight."""
    in_x, in_y = by_u * f_x, by_v * f_y
    in_z = -in_x * t_x - in_y * t_y
    return (
        in_x * move[0, 0] + in_y * move[1, 0] + in_z * move[2, 0],
        in_x * move[0, 1] + in_y * move[1, 1] + in_z * move[2, 1],
        in_x * move[0, 2] + in_y * move[1, 2] + in_z * move[2, 2],
    )


@compiled
def pull(
    camera: Array, move: Array, point: Array, pixel: Array, spread: Array, parted: float, normal: Array, right: Array
) -> tuple:
    """Add what one image says of a point (3,) in the camera frame to ``normal`` (6,), the entries 00, 01, 02, 11, 12,
    22 of J' W J, and to ``right`` (3,), J' W r; returns r' W r and the longer side of r. The camera has figures (9,)
    and stands at ``move`` (4,4)."""
    x = move[0, 0] * point[0] + move[0, 1] * point[1] + move[0, 2] * point[2] + move[0, 3]
    y = move[1, 0] * point[0] + move[1, 1] * point[1] + move[1, 2] * point[2] + move[1, 3]
    z = move[2, 0] * point[0] + move[2, 1] * point[1] + move[2, 2] * point[2] + move[2, 3]
    u, v, a, b, c, d = project(camera, x, y, z)
    r, s = pixel[0] - u, pixel[1] - v
    xx, xy, yy = spread[0, 0] + parted, spread[0, 1], spread[1, 1] + parted
    share, near = 1.0 / (xx * yy - xy * xy), 1.0 / z
    w_xx, w_xy, w_yy = share * yy, -share * xy, share * xx
    f_x, f_y, t_x, t_y = near * camera[0], near * camera[1], near * x, near * y
    along, down = w_xx * r + w_xy * s, w_xy * r + w_yy * s
    first_0, first_1, first_2 = slope_by(move, a, b, f_x, f_y, t_x, t_y)
    second_0, second_1, second_2 = slope_by(move, c, d, f_x, f_y, t_x, t_y)
    right[0] += first_0 * along + second_0 * down
    right[1] += first_1 * along + second_1 * down
    right[2] += first_2 * along + second_2 * down
    pushed_0, pulled_0 = w_xx * first_0 + w_xy * second_0, w_xy * first_0 + w_yy * second_0
    pushed_1, pulled_1 = w_xx * first_1 + w_xy * second_1, w_xy * first_1 + w_yy * second_1
    pushed_2, pulled_2 = w_xx * first_2 + w_xy * second_2, w_xy * first_2 + w_yy * second_2
    normal[0] += pushed_0 * first_0 + pulled_0 * second_0
    normal[1] += pushed_0 * first_1 + pulled_0 * second_1
    normal[2] += pushed_0 * first_2 + pulled_0 * second_2
    normal[3] += pushed_1 * first_1 + pulled_1 * second_1
    normal[4] += pushed_1 * first_2 + pulled_1 * second_2
    normal[5] += pushed_2 * first_2 + pulled_2 * second_2
    return r * along + s * down, max(abs(r), abs(s))


@compiled
def spread_out(entries: Array, matrix: Array) -> None:
    """Fill a symmetric matrix (3,3) from its entries 00, 01, 02, 11, 12, 22."""
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = entries[0], entries[3], entries[5]
    matrix[0, 1] = matrix[1, 0] = entries[1]
    matrix[0, 2] = matrix[2, 0] = entries[2]
    matrix[1, 2] = matrix[2, 1] = entries[4]


@compiled
def triangulate(
    figures: Array, moves: Array, pixels: Array, spreads: Array, n: int, parted: float, point: Array, scratch: Array
) -> float:
    """Move a point (3,) in the camera frame to where sticker n was found, and fill ``scratch`` (3,6) with the entries
    of its information and of its covariance, those of noise alone; returns the squared gap of its two rays."""
    normal, inverse, right, gap = scratch[0], scratch[1], scratch[2], 0.0
    for _ in range(MOST_STEPS):
        for k in range(6):
            normal[k] = right[k] = 0.0
        left_gap, left_px = pull(figures[0], moves[0], point, pixels[0, n], spreads[0, n], parted, normal, right)
        right_gap, right_px = pull(figures[1], moves[1], point, pixels[1, n], spreads[1, n], parted, normal, right)
        inverse_of(normal, inverse)
        x = inverse[0] * right[0] + inverse[1] * right[1] + inverse[2] * right[2]
        y = inverse[1] * right[0] + inverse[3] * right[1] + inverse[4] * right[2]
        z = inverse[2] * right[0] + inverse[4] * right[1] + inverse[5] * right[2]
        gap = left_gap + right_gap - (x * right[0] + y * right[1] + z * right[2])
        point[0], point[1], point[2] = point[0] + x, point[1] + y, point[2] + z
        if max(left_px, right_px) < LONG_PX:
            break
    trace = 0.25 * (spreads[0, n, 0, 0] + spreads[0, n, 1, 1] + spreads[1, n, 0, 0] + spreads[1, n, 1, 1])
    share = trace / (trace + parted)
    for k in range(6):
        normal[k] /= share
        inverse[k] *= share
    return gap


@compiled
def register(frame: Frame, scratch: Array, change: Array, covariance: Array) -> float:
    """Fill ``change`` (6,) [dt, dphi] of the expected place in the camera frame and its ``covariance`` (6,6), from the
    stickers used; returns the sum of their squared residuals in units of their noise. scratch (6,6) is overwritten."""
    normal, squared = scratch, 0.0
    for a in range(6):
        change[a] = 0.0
        for b in range(6):
            normal[a, b] = 0.0
    for n in range(len(frame.used)):
        if not frame.used[n]:
            continue
        arm, info, found = frame.arms[n], frame.informations[n], frame.found[n]
        x, y, z = arm[0], arm[1], arm[2]
        for i in range(3):
            push = info[i, 0] * found[0] + info[i, 1] * found[1] + info[i, 2] * found[2]
            squared += found[i] * push
            change[i] += push
            # the row of information times the slope [1, -arm x]: of the turn about each axis
            by_x, by_y, by_z = (
                info[i, 2] * y - info[i, 1] * z,
                info[i, 0] * z - info[i, 2] * x,
                info[i, 1] * x - info[i, 0] * y,
            )
            normal[3, i] += by_x
            normal[4, i] += by_y
            normal[5, i] += by_z
            for j in range(i + 1):
                normal[i, j] += info[i, j]
            # and the slope's transpose times that
            if i == 0:
                lever_y, lever_z = z, -y
                normal[4, 3] += lever_y * by_x
                normal[5, 3] += lever_z * by_x
                normal[4, 4] += lever_y * by_y
                normal[5, 4] += lever_z * by_y
                normal[5, 5] += lever_z * by_z
                change[4] += lever_y * push
                change[5] += lever_z * push
            elif i == 1:
                normal[3, 3] -= z * by_x
                normal[5, 3] += x * by_x
                normal[5, 4] += x * by_y
                normal[5, 5] += x * by_z
                change[3] -= z * push
                change[5] += x * push
            else:
                normal[3, 3] += y * by_x
                normal[4, 3] -= x * by_x
                normal[4, 4] -= x * by_y
                change[3] += y * push
                change[4] -= x * push
    before = (change[0], change[1], change[2], change[3], change[4], change[5])
    factor(normal)
    invert_factored(normal, covariance)
    solve_factored(normal, change)
    for a in range(6):
        squared -= before[a] * change[a]
    return squared


@compiled
def worst_place(frame: Frame, change: Array, covariance: Array, total: float, freedom: int, limits: Belief) -> int:
    """The sticker that differs most from where the others put it, -1 where all agree; as ``consistency``."""
    worst, largest = -1, limits.largest_misfit
    entries, inverse, half = np.empty(6), np.empty(6), np.empty((3, 6))
    for n in range(len(frame.used)):
        if not frame.used[n]:
            continue
        arm, info, found = frame.arms[n], frame.informations[n], frame.found[n]
        x = found[0] - change[0] - (change[4] * arm[2] - change[5] * arm[1])
        y = found[1] - change[1] - (change[5] * arm[0] - change[3] * arm[2])
        z = found[2] - change[2] - (change[3] * arm[1] - change[4] * arm[0])
        own = info[0, 0] * x * x + info[1, 1] * y * y + info[2, 2] * z * z
        own += 2.0 * (info[0, 1] * x * y + info[0, 2] * x * z + info[1, 2] * y * z)
        left_noise(arm, frame.covariances[n], covariance, half, entries)
        inverse_of(entries, inverse)
        misfit = inverse[0] * x * x + inverse[3] * y * y + inverse[5] * z * z
        misfit += 2.0 * (inverse[1] * x * y + inverse[2] * x * z + inverse[4] * y * z)
        misfit /= excess_of(total - own, freedom - 3, limits.totals)
        if misfit > largest:
            worst, largest = n, misfit
    return worst


@compiled
def excess_of(total: float, freedom: int, totals: Array) -> float:
    """Mean square of residuals where it is larger than noise makes it, else 1."""
    return total / freedom if total > totals[freedom] else 1.0


@compiled
def believed(frame: Frame, limits: Belief, scratch: Array, change: Array, covariance: Array) -> float:
    """``register`` the stickers that agree with each other, after those that do not were taken out; returns the factor
    by which covariances grow, 0 where too few are left or too much."""
    left_out = 0
    while True:
        count = 0
        for n in range(len(frame.used)):
            count += frame.used[n]
        if count < limits.fewest + left_out:
            return 0.0
        freedom = 3 * count - 6
        total = register(frame, scratch, change, covariance)
        excess = excess_of(total, freedom, limits.totals)
        worst = worst_place(frame, change, covariance, total, freedom, limits)
        if worst < 0:
            return excess if excess <= limits.largest_excess else 0.0
        frame.used[worst] = False
        left_out += 1
