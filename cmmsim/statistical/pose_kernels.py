"""Compiled: a pose from the stickers that two cameras find, as triangulation and registration give it to first order.

All is linear about the true pose: what is found differs from what is expected there by noise, by what teaching left and
by what is not known of the rig. With the slope J of a sticker's pixels by its place, their difference r and its inverse
covariance W, the sticker is found (sum J' W J)^-1 sum J' W r from where it is expected, and the platform by the same
least squares over the stickers. Where r is long, the slopes are taken anew at what was found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.detection.fit_kernels import FitSettings
from cmmsim.geometry.point_kernels import factor, invert_factored, solve_factored
from cmmsim.statistical.sticker_kernels import Solids, fit_covariances, hidden_stickers

SMALL_TURN = 1e-4  # rad, by which arms may turn before their slopes are taken anew
LONG_PX = 0.2  # difference between found and expected pixels beyond which slopes are taken anew
MOST_STEPS = 4
MEASURED, CAREFUL = 0, 1  # what became of a frame: a pose, or it must be looked at by the whole estimator


class Cameras(NamedTuple):
    """Both cameras: ``figures`` (2,9), their intrinsics in the order of INTRINSIC_NAMES; sizes (2,2) px; and their places
    ``moves`` (2,4,4): from the base's axes those that look, from the camera frame's those that measure."""

    figures: Array
    size: Array
    moves: Array


class Stickers(NamedTuple):
    """True and taught places (n,3) of the platform's stickers, and their normals (n,3), in its axes; radius m."""

    true: Array
    taught: Array
    normals: Array
    radius: float


class CentreNoise(NamedTuple):
    """Inverse covariance xx, xy, yy of a centre over the ellipse's mean half axis m, by m and its ovalness p, q (a,b,c,3),
    from ``first`` (3,) on in ``steps`` (3,); by_light (3,): the polynomial in the share of light by which the covariance
    grows. contrast, ring and black: grey values of full light; fit_size px and settings of the fit."""

    table: Array
    first: Array
    steps: Array
    by_light: Array
    contrast: float
    ring: float
    black: float
    fit_size: int
    settings: FitSettings


class Limits(NamedTuple):
    """What a sticker must keep to be found and believed, as the estimator has it; totals (f,): of squared residuals by
    their freedom, beyond which they are larger than noise."""

    grazing: float
    thin_px: float
    thin_std_px: float
    longest_smear_px: float
    largest_gap: float
    largest_misfit: float
    largest_excess: float
    fewest: int
    totals: Array
    clear: float
    vignetting: float
    parted: float


class Frame(NamedTuple):
    """What one frame holds of n stickers: seen (n,) whether found in both images, and used (n,) whether believed; pixels (2,n,2) and their covariances
    (2,n,2,2) px²; points (n,3) m in the camera frame, informations and covariances (n,3,3) of them, found (n,3): points
    less where they are expected, arms (n,3) from the platform's origin."""

    seen: Array
    used: Array
    pixels: Array
    spreads: Array
    points: Array
    informations: Array
    covariances: Array
    found: Array
    arms: Array


class Eyes(NamedTuple):
    """What looks and what measures: cameras at their true and at their known places, the platform's stickers with their
    owner (n,), body 0, what hides them, what noise does to centres, limits, and the taught base_from_camera and
    camera_from_base (4,4)."""

    looking: Cameras
    measuring: Cameras
    stickers: Stickers
    owners: Array
    solids: Solids
    noise: CentreNoise
    limits: Limits
    base_from_camera: Array
    camera_from_base: Array


@compiled
def pose_transform(pose: Array, transform: Array) -> None:
    """Fill the transform (4,4) of a pose (6,)."""
    ca, cb, cg = math.cos(pose[3]), math.cos(pose[4]), math.cos(pose[5])
    sa, sb, sg = math.sin(pose[3]), math.sin(pose[4]), math.sin(pose[5])
    transform[0, 0], transform[0, 1], transform[0, 2] = cb * cg, -cb * sg, sb
    transform[1, 0], transform[1, 1], transform[1, 2] = ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb
    transform[2, 0], transform[2, 1], transform[2, 2] = sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb
    transform[3, 0], transform[3, 1], transform[3, 2], transform[3, 3] = 0.0, 0.0, 0.0, 1.0
    for i in range(3):
        transform[i, 3] = pose[i]


@compiled
def multiply(first: Array, second: Array, product: Array) -> None:
    """Product of two transforms (4,4)."""
    for i in range(4):
        for j in range(4):
            product[i, j] = 0.0
            for k in range(4):
                product[i, j] += first[i, k] * second[k, j]


@compiled
def carry(move: Array, point: Array, shift: float, carried: Array) -> None:
    """A point (3,), or with ``shift`` 0 a direction, under a transform (4,4)."""
    for i in range(3):
        carried[i] = shift * move[i, 3]
        for j in range(3):
            carried[i] += move[i, j] * point[j]


@compiled
def project(camera: Array, x_m: float, y_m: float, depth: float) -> tuple:
    """Pixel u, v of a point in the axes of a camera with these figures (9,), and the slope xx, xy, yx, yy of the image by
    ideal pixels there."""
    x, y = x_m / depth, y_m / depth
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    growth = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    u = camera[0] * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + camera[2]
    v = camera[1] * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + camera[3]
    across = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    along_x = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return u, v, along_x, across * camera[0] / camera[1], across * camera[1] / camera[0], along_y


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Whether a sticker at a point (3,) in camera axes is turned towards the camera."""
    dot, squared = 0.0, 0.0
    for i in range(3):
        dot -= point[i] * normal[i]
        squared += point[i] * point[i]
    return point[2] > 1e-6 and dot > grazing * math.sqrt(squared)


@compiled
def ellipse_of(point: Array, normal: Array, radius: float, focal: Array, lens: tuple) -> tuple:
    """Of a disc in camera axes: how far the centre of its ellipse lies from its own, x and y px of a perfect lens, and
    the shape A_xx, A_xy, A_yy px in the image, whose slope by ideal pixels is ``lens``; as ``disc_kernels``."""
    squared = radius * radius
    depth = point[2] * point[2] - squared * (1.0 - normal[2] * normal[2])
    at_x = (point[0] * point[2] + squared * normal[0] * normal[2]) / depth
    at_y = (point[1] * point[2] + squared * normal[1] * normal[2]) / depth
    dual_xx = (point[0] * point[0] - squared * (1.0 - normal[0] * normal[0])) / depth
    dual_xy = (point[0] * point[1] + squared * normal[0] * normal[1]) / depth
    dual_yy = (point[1] * point[1] - squared * (1.0 - normal[1] * normal[1])) / depth
    xx = focal[0] * focal[0] * (at_x * at_x - dual_xx)
    xy = focal[0] * focal[1] * (at_x * at_y - dual_xy)
    yy = focal[1] * focal[1] * (at_y * at_y - dual_yy)
    a, b, c, d = lens
    bent_xx = a * a * xx + 2.0 * a * b * xy + b * b * yy
    bent_xy = a * c * xx + (a * d + b * c) * xy + b * d * yy
    bent_yy = c * c * xx + 2.0 * c * d * xy + d * d * yy
    root = math.sqrt(max(bent_xx * bent_yy - bent_xy * bent_xy, 0.0))
    scale = 1.0 / math.sqrt(bent_xx + bent_yy + 2.0 * root)
    shift_x, shift_y = focal[0] * (at_x - point[0] / point[2]), focal[1] * (at_y - point[1] / point[2])
    return shift_x, shift_y, scale * (bent_xx + root), scale * bent_xy, scale * (bent_yy + root)


@compiled
def holds(centre: float, reach: float, size: int) -> bool:
    """Whether what reaches so far about ``centre``, px along one axis, lies in the part of ``size`` px fitted about it."""
    local = centre - np.rint(centre - 0.5 * (size - 1))
    return local - reach > -0.5 and local + reach < size - 0.5


@compiled
def tabulated(table: Array, first: Array, steps: Array, by_light: Array, xx: float, xy: float, yy: float, light: float) -> tuple:
    """Covariance xx, xy, yy px² of the centre of an ellipse, whose shape is given, linear between the table's entries;
    first four parameters as of ``CentreNoise``."""
    mean = 0.5 * (xx + yy)
    a, b, c = (mean - first[0]) / steps[0], (0.5 * (xx - yy) / mean - first[1]) / steps[1], (xy / mean - first[2]) / steps[2]
    i = min(max(int(math.floor(a)), 0), table.shape[0] - 2)
    j = min(max(int(math.floor(b)), 0), table.shape[1] - 2)
    k = min(max(int(math.floor(c)), 0), table.shape[2] - 2)
    a, b, c = min(max(a - i, 0.0), 1.0), min(max(b - j, 0.0), 1.0), min(max(c - k, 0.0), 1.0)
    found_xx, found_xy, found_yy = 0.0, 0.0, 0.0
    for corner in range(8):
        up, across, deep = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (a if up else 1.0 - a) * (b if across else 1.0 - b) * (c if deep else 1.0 - c)
        found_xx += weight * table[i + up, j + across, k + deep, 0]
        found_xy += weight * table[i + up, j + across, k + deep, 1]
        found_yy += weight * table[i + up, j + across, k + deep, 2]
    scale = by_light[0] + light * (by_light[1] + light * by_light[2])
    scale /= mean * (found_xx * found_yy - found_xy * found_xy)
    return scale * found_yy, -scale * found_xy, scale * found_xx


@compiled
def smeared(noise: CentreNoise, shape: tuple, light: float, centre: tuple, smear: tuple) -> tuple:
    """Covariance xx, xy, yy px² of the centre of an ellipse that moves by ``smear`` px, at its own place."""
    local, found, size = np.empty((1, 2)), np.empty((1, 5, 5)), noise.fit_size
    one, moved, greys = np.empty((1, 2, 2)), np.empty((1, 2)), np.empty((2, 1))
    for i in range(2):
        local[0, i] = centre[i] - np.rint(centre[i] - 0.5 * (size - 1))
        moved[0, i] = smear[i]
        for j in range(2):
            one[0, i, j] = shape[i + j]
    greys[0, 0], greys[1, 0] = noise.contrast * light, noise.black + noise.ring * light
    fit_covariances(local, one, moved, greys[0], greys[1], size, noise.settings, found)
    return found[0, 0, 0], found[0, 0, 1], found[0, 1, 1]


@compiled
def light_at(camera: Array, size: Array, u: float, v: float, vignetting: float) -> float:
    """Relative illumination of a pixel, by a camera with these figures (9,) and size (2,)."""
    if vignetting == 0.0:
        return 1.0
    x, y = camera[2], camera[3]
    farthest_x = max(x + 0.5, size[0] - 0.5 - x)
    farthest_y = max(y + 0.5, size[1] - 0.5 - y)
    share = ((u - x) ** 2 + (v - y) ** 2) / (farthest_x**2 + farthest_y**2)
    return max(1.0 - vignetting * share, 0.0)


@compiled
def see(side: int, eyes: Eyes, moves: Array, ends: Array, moving: bool, noise: Array, frame: Frame) -> None:
    """Fill one image's pixels and covariances of the stickers that are ``used`` so far, and take out what is not seen.

    moves (b,4,4) camera_from_body of all solids, the platform first; ends (2,4,4): of the platform at the beginning and
    the end of the exposure, where it is ``moving``; noise (n,3) unit normal: of the centres, and of how thin an ellipse may
    be.
    """
    count, looking, stickers, limits = len(frame.used), eyes.looking, eyes.stickers, eyes.limits
    places, normals, hidden = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.bool_)
    for n in range(count):
        carry(moves[0], stickers.true[n], 1.0, places[n])
        carry(moves[0], stickers.normals[n], 0.0, normals[n])
        frame.used[n] = frame.used[n] and faces(places[n], normals[n], 0.0)
    hidden_stickers(moves, places, normals, eyes.owners, limits.clear, eyes.solids, frame.used, hidden)
    camera, focal, point, size = looking.figures[side], looking.figures[side, :2], np.empty(3), eyes.noise.fit_size
    table, first_node, steps, by_light = eyes.noise.table, eyes.noise.first, eyes.noise.steps, eyes.noise.by_light
    smear_step, true, pixels, spreads = eyes.noise.settings.smear_step, stickers.true, frame.pixels[side], frame.spreads[side]
    for n in range(count):
        frame.used[n] = frame.used[n] and not hidden[n]
        if not frame.used[n]:
            continue
        u, v, a, b, c, d = project(camera, places[n, 0], places[n, 1], places[n, 2])
        along, down, xx, xy, yy = ellipse_of(
            places[n], normals[n], stickers.radius, focal, (a, b, c, d)
        )
        smear_u, smear_v = 0.0, 0.0
        if moving:
            for end in range(2):
                carry(ends[end], true[n], 1.0, point)
                other_u, other_v, _, _, _, _ = project(camera, point[0], point[1], point[2])
                sign = 1.0 if end else -1.0
                smear_u += sign * other_u
                smear_v += sign * other_v
        length, smallest = math.hypot(smear_u, smear_v), 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
        frame.used[n] = (
            length < limits.longest_smear_px
            and smallest > limits.thin_px + limits.thin_std_px * noise[n, 2]
            and holds(u + along, math.hypot(xx, xy), size)
            and holds(v + down, math.hypot(xy, yy), size)
        )
        if not frame.used[n]:
            continue
        light = light_at(camera, looking.size[side], u, v, limits.vignetting)
        if length > smear_step:
            wide, tilt, high = smeared(
                eyes.noise, (xx, xy, yy), light, (u + along, v + down), (smear_u, smear_v)
            )
        else:
            wide, tilt, high = tabulated(table, first_node, steps, by_light, xx, xy, yy, light)
        first = math.sqrt(wide)
        across = tilt / first
        pixels[n, 0] = u + first * noise[n, 0]
        pixels[n, 1] = v + across * noise[n, 0] + math.sqrt(high - across * across) * noise[n, 1]
        spread = spreads[n]
        spread[0, 0], spread[0, 1], spread[1, 0], spread[1, 1] = wide, tilt, tilt, high


@compiled
def slope_by(move: Array, by_u: float, by_v: float, f_x: float, f_y: float, t_x: float, t_y: float) -> tuple:
    """Slope of one coordinate of a pixel by a point in the camera frame: by_u and by_v by the ideal pixels, which go with
    f_x and f_y, focal length over depth, and t_x and t_y, the tangents of the line of sight."""
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
    """Add what one image says of a point (3,) in the camera frame to ``normal`` (6,), the entries 00, 01, 02, 11, 12, 22
    of J' W J, and to ``right`` (3,), J' W r; returns r' W r and the longer side of r. The camera has figures (9,) and
    stands at ``move`` (4,4)."""
    x = move[0, 0] * point[0] + move[0, 1] * point[1] + move[0, 2] * point[2] + move[0, 3]
    y = move[1, 0] * point[0] + move[1, 1] * point[1] + move[1, 2] * point[2] + move[1, 3]
    z = move[2, 0] * point[0] + move[2, 1] * point[1] + move[2, 2] * point[2] + move[2, 3]
    u, v, a, b, c, d = project(camera, x, y, z)
    r, s = pixel[0] - u, pixel[1] - v
    xx, xy, yy = spread[0, 0] + parted, spread[0, 1], spread[1, 1] + parted
    det = xx * yy - xy * xy
    w_xx, w_xy, w_yy = yy / det, -xy / det, xx / det
    f_x, f_y, t_x, t_y = camera[0] / z, camera[1] / z, x / z, y / z
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
def inverse_of(n: Array, into: Array) -> None:
    """Fill the inverse (6,) of a symmetric (3,3) matrix ``n`` (6,), both as their entries 00, 01, 02, 11, 12, 22."""
    c_00, c_01, c_02 = n[3] * n[5] - n[4] * n[4], n[2] * n[4] - n[1] * n[5], n[1] * n[4] - n[2] * n[3]
    det = n[0] * c_00 + n[1] * c_01 + n[2] * c_02
    into[0], into[1], into[2] = c_00 / det, c_01 / det, c_02 / det
    into[3], into[4] = (n[0] * n[5] - n[2] * n[2]) / det, (n[1] * n[2] - n[0] * n[4]) / det
    into[5] = (n[0] * n[3] - n[1] * n[1]) / det


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
    """Move a point (3,) in the camera frame to where sticker n was found, and fill ``scratch`` (3,6) with the entries of
    its information and of its covariance, those of noise alone; returns the squared gap of its two rays."""
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
            by_x, by_y, by_z = info[i, 2] * y - info[i, 1] * z, info[i, 0] * z - info[i, 2] * x, info[i, 1] * x - info[i, 0] * y
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
def left_noise(arm: Array, noise: Array, covariance: Array, half: Array, entries: Array) -> None:
    """Fill the entries (6,) of the covariance of a sticker's residual: its noise (3,3) less what it pulls the pose by.

    arm (3,) from the platform's origin; covariance (6,6) of the pose; half (3,6) is overwritten.
    """
    x, y, z = arm[0], arm[1], arm[2]
    for b in range(6):
        half[0, b] = covariance[0, b] + z * covariance[4, b] - y * covariance[5, b]
        half[1, b] = covariance[1, b] - z * covariance[3, b] + x * covariance[5, b]
        half[2, b] = covariance[2, b] + y * covariance[3, b] - x * covariance[4, b]
    entries[0] = noise[0, 0] - (half[0, 0] + z * half[0, 4] - y * half[0, 5])
    entries[1] = noise[0, 1] - (half[0, 1] - z * half[0, 3] + x * half[0, 5])
    entries[2] = noise[0, 2] - (half[0, 2] + y * half[0, 3] - x * half[0, 4])
    entries[3] = noise[1, 1] - (half[1, 1] - z * half[1, 3] + x * half[1, 5])
    entries[4] = noise[1, 2] - (half[1, 2] + y * half[1, 3] - x * half[1, 4])
    entries[5] = noise[2, 2] - (half[2, 2] + y * half[2, 3] - x * half[2, 4])


@compiled
def worst_place(frame: Frame, change: Array, covariance: Array, total: float, freedom: int, limits: Limits) -> int:
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
def believed(frame: Frame, limits: Limits, scratch: Array, change: Array, covariance: Array) -> float:
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


@compiled
def move_by(transform: Array, change: Array) -> None:
    """Move a transform (4,4) by ``change`` (6,) [dt, dphi], in the axes of its output."""
    turn = change[3:]
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    first = math.sin(angle) / angle if angle > 1e-9 else 1.0
    second = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-9 else 0.5
    for j in range(3):
        x = turn[1] * transform[2, j] - turn[2] * transform[1, j]
        y = turn[2] * transform[0, j] - turn[0] * transform[2, j]
        z = turn[0] * transform[1, j] - turn[1] * transform[0, j]
        transform[0, j] += first * x + second * (turn[1] * z - turn[2] * y)
        transform[1, j] += first * y + second * (turn[2] * x - turn[0] * z)
        transform[2, j] += first * z + second * (turn[0] * y - turn[1] * x)
    for i in range(3):
        transform[i, 3] += change[i]


@compiled
def base_pose(place: Array, covariance: Array, base_from_camera: Array, pose: Array, spread: Array) -> None:
    """Fill the pose (6,) and its covariance (6,6) in the base frame, of camera_from_platform ``place`` (4,4) and the
    covariance (6,6) of its small error."""
    measured = np.empty((4, 4))
    multiply(base_from_camera, place, measured)
    for i in range(3):
        pose[i] = measured[i, 3]
    pose[3] = math.atan2(-measured[1, 2], measured[2, 2])
    pose[4] = math.atan2(measured[0, 2], math.hypot(measured[1, 2], measured[2, 2]))
    pose[5] = math.atan2(-measured[0, 1], measured[0, 0])
    ca, sa, cb, sb = math.cos(pose[3]), math.sin(pose[3]), math.cos(pose[4]), math.sin(pose[4])
    rates = np.empty((3, 3))  # [d alpha, d beta, d gamma] by the rotation vector: the inverse of euler_rates_matrix
    rates[0, 0], rates[0, 1], rates[0, 2] = 1.0, sa * sb / cb, -ca * sb / cb
    rates[1, 0], rates[1, 1], rates[1, 2] = 0.0, ca, sa
    rates[2, 0], rates[2, 1], rates[2, 2] = 0.0, -sa / cb, ca / cb
    slopes, half = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            slopes[i, j] = base_from_camera[i, j]
            for k in range(3):
                slopes[3 + i, 3 + j] += rates[i, k] * base_from_camera[k, j]
    for i in range(6):
        for j in range(6):
            for k in range(6):
                half[i, j] += slopes[i, k] * covariance[k, j]
    for i in range(6):
        for j in range(6):
            spread[i, j] = 0.0
            for k in range(6):
                spread[i, j] += half[i, k] * slopes[j, k]


@compiled
def look(eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame) -> None:
    """Fill what both cameras find: pixels and covariances, and which stickers are used.

    poses (6,6): in the middle, at the beginning and at the end of the left camera's exposure, then of the right one's;
    bodies (b,4,4): base_from_body of all solids but the platform; noise (2,n,3) unit normal; kept (n,) whether a sticker
    is not left out by chance.
    """
    moving = False
    for i in range(6):
        moving = moving or poses[1, i] != poses[2, i]
    for n in range(len(kept)):
        frame.used[n] = kept[n]
    platform, moves, ends = np.empty((4, 4)), np.empty((1 + len(bodies), 4, 4)), np.empty((2, 4, 4))
    for side in range(2):
        for end in range(2):
            pose_transform(poses[3 * side + 1 + end], platform)
            multiply(eyes.looking.moves[side], platform, ends[end])
        pose_transform(poses[3 * side], platform)
        multiply(eyes.looking.moves[side], platform, moves[0])
        for b in range(len(bodies)):
            multiply(eyes.looking.moves[side], bodies[b], moves[1 + b])
        see(side, eyes, moves, ends, moving, noise[side], frame)


@compiled
def expect(eyes: Eyes, place: Array, frame: Frame) -> None:
    """Take out stickers that nobody looks for with the platform at ``place`` (4,4), and triangulate the others."""
    expected, seen, normal, scratch = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 6))
    figures, moves, size = eyes.measuring.figures, eyes.measuring.moves, eyes.measuring.size
    taught, normals, pixels, spreads = eyes.stickers.taught, eyes.stickers.normals, frame.pixels, frame.spreads
    used, arms, points, found = frame.used, frame.arms, frame.points, frame.found
    grazing, parted, largest_gap = eyes.limits.grazing, eyes.limits.parted, eyes.limits.largest_gap
    for n in range(len(used)):
        carry(place, taught[n], 1.0, expected)
        carry(place, normals[n], 0.0, arms[n])
        for side in range(2):
            carry(moves[side], expected, 1.0, seen)
            carry(moves[side], arms[n], 0.0, normal)
            used[n] = used[n] and faces(seen, normal, grazing)
            for i in range(2):
                used[n] = used[n] and -0.5 < pixels[side, n, i] < size[side, i] - 0.5
        if used[n]:
            for i in range(3):
                arms[n, i] = expected[i] - place[i, 3]
                points[n, i] = expected[i]
            used[n] = triangulate(figures, moves, pixels, spreads, n, parted, points[n], scratch) < largest_gap
            spread_out(scratch[0], frame.informations[n])
            spread_out(scratch[1], frame.covariances[n])
            for i in range(3):
                found[n, i] = points[n, i] - expected[i]
        frame.seen[n] = used[n]


@compiled
def measure_frame(
    eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame, pose: Array, spread: Array
) -> int:
    """Fill the measured pose (6,) and its covariance (6,6); parameters as of ``look``. Returns what became of it."""
    look(eyes, poses, bodies, noise, kept, frame)
    platform, place = np.empty((4, 4)), np.empty((4, 4))
    pose_transform(poses[0], platform)
    multiply(eyes.camera_from_base, platform, place)
    expect(eyes, place, frame)
    scratch, change, covariance, excess = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), 1.0
    for _ in range(MOST_STEPS):
        excess = believed(frame, eyes.limits, scratch, change, covariance)
        if excess == 0.0:
            return CAREFUL
        move_by(place, change)
        if max(abs(change[3]), abs(change[4]), abs(change[5])) < SMALL_TURN:
            break
        for n in range(len(frame.used)):  # the arms have turned: what is found is compared with the new place
            if frame.used[n]:
                carry(place, eyes.stickers.taught[n], 0.0, frame.arms[n])
                for i in range(3):
                    frame.found[n, i] = frame.points[n, i] - place[i, 3] - frame.arms[n, i]
    for i in range(6):
        for j in range(6):
            covariance[i, j] *= excess
    for n in range(len(frame.used)):
        for i in range(3):
            for j in range(3):
                frame.covariances[n, i, j] *= excess
    base_pose(place, covariance, eyes.base_from_camera, pose, spread)
    return MEASURED


@compiled
def measure_frames(
    eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame, found: Array, spreads: Array,
    counts: Array, states: Array,
) -> None:  # fmt: skip
    """``measure_frame`` of N frames: poses (N,6,6), bodies (b,4,4) that stand still, noise (N,2,n,3), kept (N,n); fills
    found (N,6), spreads (N,6,6), counts (N,) of stickers used, and states (N,)."""
    for k in range(len(poses)):
        states[k] = measure_frame(eyes, poses[k], bodies, noise[k], kept[k], frame, found[k], spreads[k])
        counts[k] = 0
        for n in range(len(frame.used)):
            counts[k] += frame.used[n]
