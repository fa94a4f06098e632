"""Compiled: a pose from what two cameras find of the platform's stickers, frame after frame.

What is found is compared with what is expected at the true pose: it differs by noise, by what teaching left and by what
is not known of the rig.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.geometry.point_kernels import move_by
from cmmsim.statistical.camera_kernels import (
    carry,
    ellipse_of,
    faces,
    length_of,
    light_at,
    multiply,
    pose_transform,
    project,
)
from cmmsim.statistical.centre_kernels import CentreNoise, holds, smeared, tabulated
from cmmsim.statistical.hiding_kernels import Solids, hidden_stickers
from cmmsim.statistical.solving_kernels import MOST_STEPS, Belief, Frame, believed, spread_out, triangulate

SMALL_TURN = 1e-4  # rad, by which arms may turn before their slopes are taken anew
MEASURED, CAREFUL = 0, 1  # what became of a frame: a pose, or it must be looked at by the whole estimator


class Cameras(NamedTuple):
    """Both cameras: ``figures`` (2,9), their intrinsics in the order of INTRINSIC_NAMES; sizes (2,2) px; and their
    places ``moves`` (2,4,4): from the base's axes those that look, from the camera frame's those that measure."""

    figures: Array
    size: Array
    moves: Array


class Stickers(NamedTuple):
    """True and taught places (n,3) of the platform's stickers, and their normals (n,3), in its axes; radius m."""

    true: Array
    taught: Array
    normals: Array
    radius: float


class Limits(NamedTuple):
    """What a sticker must keep to be found: turned to both cameras by more than the cosine ``grazing``; thin_px and
    thin_std_px: how thin an ellipse may be, and how softly; largest squared gap of its two rays; clear m about it;
    vignetting of the lens; parted px²: variance by which what is not known of the rig parts its rays."""

    grazing: float
    thin_px: float
    thin_std_px: float
    largest_gap: float
    clear: float
    vignetting: float
    parted: float


class Eyes(NamedTuple):
    """What looks and what measures: cameras at their true and at their known places, the platform's stickers with
    their owner (n,), body 0, what hides them, what noise does to centres, what is found and believed, and the taught
    base_from_camera and camera_from_base (4,4)."""

    looking: Cameras
    measuring: Cameras
    stickers: Stickers
    owners: Array
    solids: Solids
    noise: CentreNoise
    limits: Limits
    belief: Belief
    base_from_camera: Array
    camera_from_base: Array


@compiled
def see(side: int, eyes: Eyes, moves: Array, ends: Array, moving: bool, noise: Array, frame: Frame) -> None:
    """Fill one image's pixels and covariances of the stickers that are ``used`` so far, and take out what is not seen.

    moves (b,4,4) camera_from_body of all solids, the platform first; ends (2,4,4): of the platform at the beginning
    and the end of the exposure, where it is ``moving``; noise (n,3) unit normal: of the centres, and of how thin an
    ellipse may be.
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
    smear_step, true, pixels, spreads = (
        eyes.noise.settings.smear_step,
        stickers.true,
        frame.pixels[side],
        frame.spreads[side],
    )
    for n in range(count):
        frame.used[n] = frame.used[n] and not hidden[n]
        if not frame.used[n]:
            continue
        u, v, a, b, c, d = project(camera, places[n, 0], places[n, 1], places[n, 2])
        along, down, xx, xy, yy = ellipse_of(places[n], normals[n], stickers.radius, focal, (a, b, c, d))
        smear_u, smear_v = 0.0, 0.0
        if moving:
            for end in range(2):
                carry(ends[end], true[n], 1.0, point)
                other_u, other_v, _, _, _, _ = project(camera, point[0], point[1], point[2])
                sign = 1.0 if end else -1.0
                smear_u += sign * other_u
                smear_v += sign * other_v
        length = length_of(smear_u, smear_v)
        frame.longest[0] = max(frame.longest[0], length)
        smallest = 0.5 * (xx + yy) - length_of(0.5 * (xx - yy), xy)
        frame.used[n] = (
            smallest > limits.thin_px + limits.thin_std_px * noise[n, 2]
            and holds(u + along, length_of(xx, xy), size)
            and holds(v + down, length_of(xy, yy), size)
        )
        if not frame.used[n]:
            continue
        light = light_at(camera, looking.size[side], u, v, limits.vignetting)
        if length > smear_step:
            wide, tilt, high = smeared(eyes.noise, (xx, xy, yy), light, (u + along, v + down), (smear_u, smear_v))
        else:
            wide, tilt, high = tabulated(table, first_node, steps, by_light, xx, xy, yy, light)
        first = math.sqrt(wide)
        across = tilt / first
        pixels[n, 0] = u + first * noise[n, 0]
        pixels[n, 1] = v + across * noise[n, 0] + math.sqrt(high - across * across) * noise[n, 1]
        spread = spreads[n]
        spread[0, 0], spread[0, 1], spread[1, 0], spread[1, 1] = wide, tilt, tilt, high
        frame.variances[n] = 0.25 * (wide + high) + (frame.variances[n] if side else 0.0)


@compiled
def look(eyes: Eyes, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame) -> None:
    """Fill what both cameras find: pixels and covariances, and which stickers are used.

    poses (6,6): in the middle, at the beginning and at the end of the left camera's exposure, then of the right one's;
    bodies (b,4,4): base_from_body of all solids but the platform; noise (2,n,3) unit normal; kept (n,) whether a
    sticker is not left out by chance.
    """
    moving, apart = False, False
    for i in range(6):
        moving, apart = moving or poses[1, i] != poses[2, i], apart or poses[3, i] != poses[0, i]
    frame.longest[0] = 0.0
    for n in range(len(kept)):
        frame.used[n] = kept[n]
    platform, moves, ends = np.empty((4, 4)), np.empty((1 + len(bodies), 4, 4)), np.empty((2, 4, 4))
    for side in range(2):
        for end in range(2 if moving else 0):
            pose_transform(poses[3 * side + 1 + end], platform)
            multiply(eyes.looking.moves[side], platform, ends[end])
        if side == 0 or moving or apart:
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
        excess = believed(frame, eyes.belief, scratch, change, covariance)
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
) -> float:  # fmt: skip
    """``measure_frame`` of N frames: poses (N,6,6), bodies (b,4,4) that stand still, noise (N,2,n,3), kept (N,n);
    fills found (N,6), spreads (N,6,6), counts (N,) of stickers used, and states (N,). Returns the longest way of a
    sticker, px."""
    longest = 0.0
    for k in range(len(poses)):
        states[k] = measure_frame(eyes, poses[k], bodies, noise[k], kept[k], frame, found[k], spreads[k])
        counts[k] = 0
        for n in range(len(frame.used)):
            counts[k] += frame.used[n]
        longest = max(longest, frame.longest[0])
    return longest
