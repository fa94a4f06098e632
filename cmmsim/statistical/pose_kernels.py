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
    """Both cameras: focal lengths and principal points (2,2) px, distortion (2,5), sizes (2,2) px, and their places
    ``moves`` (2,4,4): from the base's axes those that look, from the camera frame's those that measure."""

    focal: Array
    centre: Array
    distortion: Array
    size: Array
    moves: Array


class Stickers(NamedTuple):
    """True and taught places (n,3) of the platform's stickers, and their normals (n,3), in its axes; radius m."""

    true: Array
    taught: Array
    normals: Array
    radius: float


class CentreNoise(NamedTuple):
    """Covariance xx, xy, yy of a centre, times the ellipse's mean radius m, over m and its ovalness p, q (a,b,c,3), from
    ``first`` (3,) on in ``steps`` (3,); by_light (3,): the polynomial in the share of light by which it grows. contrast
    and ground: grey values of full light; fit_size px and settings of the fit."""

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
    smallest_px: float
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


@compiled
def pose_transform(pose: Array, transform: Array) -> None:
    """Fill the transform (4,4) of a pose (6,)."""
    ca, cb, cg = math.cos(pose[3]), math.cos(pose[4]), math.cos(pose[5])
    sa, sb, sg = math.sin(pose[3]), math.sin(pose[4]), math.sin(pose[5])
    transform[0, 0], transform[0, 1], transform[0, 2] = cb * cg, -cb * sg, sb
    transform[1, 0], transform[1, 1], transform[1, 2] = ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb
    transform[2, 0], transform[2, 1], transform[2, 2] = sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb
    transform[3, :3], transform[3, 3] = 0.0, 1.0
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
def project(cameras: Cameras, side: int, point: Array, pixel: Array, lens: Array, slope: Array) -> None:
    """Fill the pixel (2,) of a point (3,) in camera axes, its slope (2,3) by the point, and that of the image by the
    ideal pixels, ``lens`` (2,2)."""
    k1, k2, p1, p2, k3 = cameras.distortion[side]
    x, y = point[0] / point[2], point[1] / point[2]
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    growth = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
    focal = cameras.focal[side]
    pixel[0] = focal[0] * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + cameras.centre[side, 0]
    pixel[1] = focal[1] * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + cameras.centre[side, 1]
    across = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    lens[0, 0] = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    lens[1, 1] = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    lens[0, 1], lens[1, 0] = across * focal[0] / focal[1], across * focal[1] / focal[0]
    for i in range(2):
        slope[i, 0], slope[i, 1] = lens[i, 0] * focal[0] / point[2], lens[i, 1] * focal[1] / point[2]
        slope[i, 2] = -slope[i, 0] * x - slope[i, 1] * y


@compiled
def faces(point: Array, normal: Array, grazing: float) -> bool:
    """Whether a sticker at a point (3,) in camera axes is turned towards the camera."""
    dot, squared = 0.0, 0.0
    for i in range(3):
        dot -= point[i] * normal[i]
        squared += point[i] * point[i]
    return point[2] > 1e-6 and dot > grazing * math.sqrt(squared)


@compiled
def ellipse_of(point: Array, normal: Array, radius: float, focal: Array, lens: Array, shift: Array, shape: Array) -> None:
    """Fill the shape A (2,2) px of a disc's ellipse in the image, and how far its centre lies from that of the disc,
    ``shift`` (2,) px of a perfect lens; as ``disc_kernels.project_all``."""
    depth = point[2] ** 2 - radius**2 * (1.0 - normal[2] ** 2)
    square, bent, at = np.empty((2, 2)), np.empty((2, 2)), np.empty(2)
    for i in range(2):
        at[i] = (point[i] * point[2] + radius**2 * normal[i] * normal[2]) / depth
        shift[i] = focal[i] * (at[i] - point[i] / point[2])
    for i in range(2):
        for j in range(2):
            across = 1.0 if i == j else 0.0
            dual = (point[i] * point[j] - radius**2 * (across - normal[i] * normal[j])) / depth
            square[i, j] = focal[i] * focal[j] * (at[i] * at[j] - dual)
    for i in range(2):
        for j in range(2):
            bent[i, j] = 0.0
            for k in range(2):
                for m in range(2):
                    bent[i, j] += lens[i, k] * square[k, m] * lens[j, m]
    d = math.sqrt(max(bent[0, 0] * bent[1, 1] - bent[0, 1] ** 2, 0.0))
    scale = math.sqrt(bent[0, 0] + bent[1, 1] + 2.0 * d)
    for i in range(2):
        for j in range(2):
            shape[i, j] = (bent[i, j] + (d if i == j else 0.0)) / scale


@compiled
def fits_inside(centre: Array, shape: Array, size: int, smallest: float) -> bool:
    """Whether an ellipse about ``centre`` (2,) px is large enough and lies wholly in the part of ``size`` px that is
    fitted about it."""
    mean = 0.5 * (shape[0, 0] + shape[1, 1])
    if mean - math.hypot(0.5 * (shape[0, 0] - shape[1, 1]), shape[0, 1]) <= smallest:
        return False
    for i in range(2):
        local = centre[i] - np.rint(centre[i] - 0.5 * (size - 1))
        reach = math.hypot(shape[i, 0], shape[i, 1])
        if local - reach <= -0.5 or local + reach >= size - 0.5:
            return False
    return True


@compiled
def tabulated(noise: CentreNoise, shape: Array, light: float, spread: Array) -> None:
    """Fill the covariance (2,2) px² of a centre from the table, linear between its entries."""
    mean = 0.5 * (shape[0, 0] + shape[1, 1])
    at, cell = np.empty(3), np.empty(3, np.int64)
    at[0], at[1], at[2] = mean, 0.5 * (shape[0, 0] - shape[1, 1]) / mean, shape[0, 1] / mean
    for i in range(3):
        place = (at[i] - noise.first[i]) / noise.steps[i]
        cell[i] = min(max(int(math.floor(place)), 0), noise.table.shape[i] - 2)
        at[i] = min(max(place - cell[i], 0.0), 1.0)
    scale = (noise.by_light[0] + light * (noise.by_light[1] + light * noise.by_light[2])) / mean
    xx, xy, yy = 0.0, 0.0, 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (at[0] if a else 1.0 - at[0]) * (at[1] if b else 1.0 - at[1]) * (at[2] if c else 1.0 - at[2])
                entry = noise.table[cell[0] + a, cell[1] + b, cell[2] + c]
                xx += weight * entry[0]
                xy += weight * entry[1]
                yy += weight * entry[2]
    spread[0, 0], spread[0, 1], spread[1, 0], spread[1, 1] = scale * xx, scale * xy, scale * xy, scale * yy


@compiled
def smeared(noise: CentreNoise, shape: Array, light: float, centre: Array, smear: Array, spread: Array) -> None:
    """Fill the covariance (2,2) px² of the centre of an ellipse that moves by ``smear`` (2,) px, at its own place."""
    local, found, size = np.empty((1, 2)), np.empty((1, 5, 5)), noise.fit_size
    for i in range(2):
        local[0, i] = centre[i] - np.rint(centre[i] - 0.5 * (size - 1))
    contrasts = np.full(1, noise.contrast * light)
    ground = noise.black + noise.ring * light
    one, moved = np.empty((1, 2, 2)), np.empty((1, 2))
    one[0], moved[0] = shape, smear
    fit_covariances(local, one, moved, contrasts, ground, size, noise.settings, found)
    spread[:] = found[0, :2, :2]


@compiled
def light_at(cameras: Cameras, side: int, pixel: Array, vignetting: float) -> float:
    """Relative illumination of a pixel (2,)."""
    farthest, squared = 0.0, 0.0
    for i in range(2):
        low, high = cameras.centre[side, i] + 0.5, cameras.size[side, i] - 0.5 - cameras.centre[side, i]
        farthest += max(abs(low), abs(high)) ** 2
        squared += (pixel[i] - cameras.centre[side, i]) ** 2
    return max(1.0 - vignetting / farthest * squared, 0.0)


@compiled
def see(
    side: int, looking: Cameras, stickers: Stickers, solids: Solids, noise: CentreNoise, limits: Limits, moves: Array,
    ends: Array, normal_noise: Array, owners: Array, frame: Frame,
) -> None:  # fmt: skip
    """Fill one image's pixels and covariances of the stickers that are ``used`` so far, and take out what is not seen.

    moves (b,4,4) camera_from_body of all solids, the platform first; ends (2,4,4): of the platform at the beginning and
    the end of the exposure; normal_noise (n,2).
    """
    count = len(frame.used)
    places, normals, hidden = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.bool_)
    for n in range(count):
        carry(moves[0], stickers.true[n], 1.0, places[n])
        carry(moves[0], stickers.normals[n], 0.0, normals[n])
        frame.used[n] = frame.used[n] and faces(places[n], normals[n], 0.0)
    hidden_stickers(moves, places, normals, owners, limits.clear, solids, frame.used, hidden)
    lens, slope, shape, shift = np.empty((2, 2)), np.empty((2, 3)), np.empty((2, 2)), np.empty(2)
    first, last, point, smear = np.empty(2), np.empty(2), np.empty(3), np.empty(2)
    for n in range(count):
        if not frame.used[n] or hidden[n]:
            frame.used[n] = False
            continue
        pixel, spread = frame.pixels[side, n], frame.spreads[side, n]
        carry(ends[0], stickers.true[n], 1.0, point)
        project(looking, side, point, first, lens, slope)
        carry(ends[1], stickers.true[n], 1.0, point)
        project(looking, side, point, last, lens, slope)
        project(looking, side, places[n], pixel, lens, slope)
        ellipse_of(places[n], normals[n], stickers.radius, looking.focal[side], lens, shift, shape)
        smear[:] = last - first
        shift += pixel
        length = math.hypot(smear[0], smear[1])
        if length >= limits.longest_smear_px or not fits_inside(shift, shape, noise.fit_size, limits.smallest_px):
            frame.used[n] = False
            continue
        light = light_at(looking, side, pixel, limits.vignetting)
        if length > noise.settings.smear_step:
            smeared(noise, shape, light, shift, smear, spread)
        else:
            tabulated(noise, shape, light, spread)
        low = math.sqrt(spread[0, 0])
        across = spread[0, 1] / low
        pixel[0] += low * normal_noise[n, 0]
        pixel[1] += across * normal_noise[n, 0] + math.sqrt(spread[1, 1] - across * across) * normal_noise[n, 1]


@compiled
def triangulate(measuring: Cameras, expected: Array, limits: Limits, frame: Frame, n: int) -> bool:
    """Fill point, information, covariance and ``found`` of sticker n, expected at (3,) in the camera frame; whether its
    two rays meet."""
    lens, slope, pixel, residual = np.empty((2, 2)), np.empty((2, 3)), np.empty(2), np.empty(2)
    weight, point, pulled, turned = np.empty((2, 2)), frame.points[n], np.empty(3), np.empty((2, 3))
    normal, factored = np.empty((3, 3)), np.empty((3, 3))
    point[:] = expected
    trace, gap = 0.0, 0.0
    for side in range(2):
        trace += 0.25 * (frame.spreads[side, n, 0, 0] + frame.spreads[side, n, 1, 1])
    for step in range(MOST_STEPS):
        longest, gap = 0.0, 0.0
        normal[:], pulled[:] = 0.0, 0.0
        for side in range(2):
            seen = np.empty(3)
            carry(measuring.moves[side], point, 1.0, seen)
            project(measuring, side, seen, pixel, lens, slope)
            spread = frame.spreads[side, n]
            xx, xy, yy = spread[0, 0] + limits.parted, spread[0, 1], spread[1, 1] + limits.parted
            det = xx * yy - xy * xy
            weight[0, 0], weight[0, 1], weight[1, 0], weight[1, 1] = yy / det, -xy / det, -xy / det, xx / det
            for k in range(2):
                residual[k] = frame.pixels[side, n, k] - pixel[k]
                longest = max(longest, abs(residual[k]))
                for j in range(3):
                    turned[k, j] = 0.0
                    for i in range(3):
                        turned[k, j] += slope[k, i] * measuring.moves[side, i, j]
            for k in range(2):
                for m in range(2):
                    gap += residual[k] * weight[k, m] * residual[m]
                    for i in range(3):
                        weighted = turned[k, i] * weight[k, m]
                        pulled[i] += weighted * residual[m]
                        for j in range(3):
                            normal[i, j] += weighted * turned[m, j]
        factored[:] = normal
        factor(factored)
        before = pulled.copy()
        solve_factored(factored, pulled)
        for i in range(3):
            gap -= before[i] * pulled[i]
            point[i] += pulled[i]
        if longest < LONG_PX:
            break
    invert_factored(factored, frame.covariances[n])
    share = trace / (trace + limits.parted)
    for i in range(3):
        frame.found[n, i] = point[i] - expected[i]
        for j in range(3):
            frame.covariances[n, i, j] *= share
            frame.informations[n, i, j] = normal[i, j] / share
    return gap < limits.largest_gap


@compiled
def register(frame: Frame, change: Array, covariance: Array) -> float:
    """Fill ``change`` (6,) [dt, dphi] of the expected place in the camera frame and its ``covariance`` (6,6), from the
    stickers used; returns the sum of their squared residuals in units of their noise."""
    normal, rows, squared = np.zeros((6, 6)), np.zeros((3, 6)), 0.0
    change[:] = 0.0
    for n in range(len(frame.used)):
        if not frame.used[n]:
            continue
        arm, information = frame.arms[n], frame.informations[n]
        fill_rows(arm, rows)
        for i in range(3):
            for j in range(3):
                squared += frame.found[n, i] * information[i, j] * frame.found[n, j]
                for a in range(6):
                    if rows[i, a] == 0.0:
                        continue
                    weighted = rows[i, a] * information[i, j]
                    change[a] += weighted * frame.found[n, j]
                    for b in range(a + 1):
                        normal[a, b] += weighted * rows[j, b]
    before = change.copy()
    factor(normal)
    invert_factored(normal, covariance)
    solve_factored(normal, change)
    for a in range(6):
        squared -= before[a] * change[a]
    return squared


@compiled
def fill_rows(arm: Array, rows: Array) -> None:
    """Slope (3,6) of a point by [dt, dphi] of its body, ``arm`` (3,) from the body's origin."""
    for i in range(3):
        rows[i, i] = 1.0
    rows[0, 4], rows[0, 5], rows[1, 5] = arm[2], -arm[1], arm[0]
    rows[1, 3], rows[2, 3], rows[2, 4] = -arm[2], arm[1], -arm[0]


@compiled
def worst_place(frame: Frame, change: Array, covariance: Array, total: float, freedom: int, limits: Limits) -> int:
    """The sticker that differs most from where the others put it, -1 where all agree; as ``consistency``."""
    worst, largest = -1, limits.largest_misfit
    rows, residual, spread, solved = np.zeros((3, 6)), np.empty(3), np.empty((3, 3)), np.empty(3)
    for n in range(len(frame.used)):
        if not frame.used[n]:
            continue
        fill_rows(frame.arms[n], rows)
        own = 0.0
        for i in range(3):
            residual[i] = frame.found[n, i]
            for a in range(6):
                residual[i] -= rows[i, a] * change[a]
            for j in range(i + 1):
                spread[i, j] = frame.covariances[n, i, j]
                for a in range(6):
                    for b in range(6):
                        spread[i, j] -= rows[i, a] * covariance[a, b] * rows[j, b]
        for i in range(3):
            for j in range(3):
                own += residual[i] * frame.informations[n, i, j] * residual[j]
        factor(spread)
        solved[:] = residual
        solve_factored(spread, solved)
        misfit = residual[0] * solved[0] + residual[1] * solved[1] + residual[2] * solved[2]
        misfit /= excess_of(total - own, freedom - 3, limits)
        if misfit > largest:
            worst, largest = n, misfit
    return worst


@compiled
def excess_of(total: float, freedom: int, limits: Limits) -> float:
    """Mean square of residuals where it is larger than noise makes it, else 1."""
    return total / freedom if total > limits.totals[freedom] else 1.0


@compiled
def believed(frame: Frame, limits: Limits, change: Array, covariance: Array) -> float:
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
        total = register(frame, change, covariance)
        excess = excess_of(total, freedom, limits)
        worst = worst_place(frame, change, covariance, total, freedom, limits)
        if worst < 0:
            return excess if excess <= limits.largest_excess else 0.0
        frame.used[worst] = False
        left_out += 1


@compiled
def move_by(transform: Array, change: Array) -> None:
    """Move a transform (4,4) by ``change`` (6,) [dt, dphi], in the axes of its output."""
    turn, column = change[3:], np.empty(3)
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    first = math.sin(angle) / angle if angle > 1e-9 else 1.0
    second = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-9 else 0.5
    for j in range(3):
        column[:] = transform[:3, j]
        x = turn[1] * column[2] - turn[2] * column[1]
        y = turn[2] * column[0] - turn[0] * column[2]
        z = turn[0] * column[1] - turn[1] * column[0]
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
def look(eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame) -> None:
    """Fill what both cameras find: pixels and covariances, and which stickers are used.

    poses (6,6): in the middle, at the beginning and at the end of the left camera's exposure, then of the right one's;
    bodies (b,4,4): base_from_body of all solids but the platform; noise (2,n,2) unit normal; kept (n,) whether a sticker
    is not left out by chance.
    """
    frame.used[:] = kept
    platform, moves, ends = np.empty((4, 4)), np.empty((1 + len(bodies), 4, 4)), np.empty((2, 4, 4))
    for side in range(2):
        for end in range(2):
            pose_transform(poses[3 * side + 1 + end], platform)
            multiply(eyes.looking.moves[side], platform, ends[end])
        pose_transform(poses[3 * side], platform)
        multiply(eyes.looking.moves[side], platform, moves[0])
        for b in range(len(bodies)):
            multiply(eyes.looking.moves[side], bodies[b], moves[1 + b])
        see(
            side, eyes.looking, eyes.stickers, eyes.solids, eyes.noise, eyes.limits, moves, ends, noise[side],
            eyes.owners, frame,
        )  # fmt: skip


@compiled
def expect(eyes: Eyes, place: Array, frame: Frame) -> None:
    """Take out stickers that nobody looks for with the platform at ``place`` (4,4), and triangulate the others."""
    point, seen, normal = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(frame.used)):
        carry(place, eyes.stickers.taught[n], 1.0, point)
        for side in range(2):
            move = eyes.measuring.moves[side]
            carry(move, point, 1.0, seen)
            carry(place, eyes.stickers.normals[n], 0.0, frame.arms[n])
            carry(move, frame.arms[n], 0.0, normal)
            frame.used[n] = frame.used[n] and faces(seen, normal, eyes.limits.grazing)
            for i in range(2):
                inside = -0.5 < frame.pixels[side, n, i] < eyes.measuring.size[side, i] - 0.5
                frame.used[n] = frame.used[n] and inside
        if frame.used[n]:
            for i in range(3):
                frame.arms[n, i] = point[i] - place[i, 3]
            frame.used[n] = triangulate(eyes.measuring, point, eyes.limits, frame, n)
        frame.seen[n] = frame.used[n]


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
    change, covariance, excess = np.empty(6), np.empty((6, 6)), 1.0
    for _ in range(MOST_STEPS):
        excess = believed(frame, eyes.limits, change, covariance)
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
    frame.covariances[:] *= excess
    base_pose(place, covariance, eyes.base_from_camera, pose, spread)
    return MEASURED


@compiled
def measure_frames(
    eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame, found: Array, spreads: Array,
    counts: Array, states: Array,
) -> None:  # fmt: skip
    """``measure_frame`` of N frames: poses (N,6,6), bodies (b,4,4) that stand still, noise (N,2,n,2), kept (N,n); fills
    found (N,6), spreads (N,6,6), counts (N,) of stickers used, and states (N,)."""
    for k in range(len(poses)):
        states[k] = measure_frame(eyes, poses[k], bodies, noise[k], kept[k], frame, found[k], spreads[k])
        counts[k] = 0
        for n in range(len(frame.used)):
            counts[k] += frame.used[n]
