"""Compiled kernels that simulate measured poses frame by frame, without images.

Noise is added to the image centres of stickers in the true cameras. The assumed cameras triangulate
these centres, and the pose is fitted to the points as for images.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, faces, length_of, light_at, project
from cmmsim.geometry.disc_kernels import disc_ellipse, distorted_root
from cmmsim.geometry.matrix_kernels import from_entries
from cmmsim.geometry.transform_kernels import (
    multiply,
    pose_covariance,
    pose_transform,
    transform_point,
    transform_pose,
)
from cmmsim.geometry.triangulation_kernels import signed_distance, triangulate_point
from cmmsim.measuring.outline_kernels import Outlines
from cmmsim.measuring.shared_error_kernels import Images
from cmmsim.measuring.solver_kernels import (
    MEASURED,
    STATE,
    ObservedStickers,
    SolverLimits,
    solve,
)
from cmmsim.without_images.drawn_fit_kernels import CentreNoise, contains, smeared, tabulated
from cmmsim.without_images.hiding_kernels import Solids, hidden_stickers

# A triangulation starts at the expected position, and ends with a step shorter than this, m.
STEP_TOLERANCE = 2e-4


class Frame(NamedTuple):
    """Stickers in both images of one frame.

    stickers   mask of the used stickers, and triangulated points
    pixels     (n, 2, 2), centres in both images, px
    spreads    (n, 2, 2, 2), covariances of the pixels, px²
    variances  (n,), variance of a pixel coordinate, mean over both images, px²
    longest    (1,), longest path of a sticker during the exposure, px
    """

    stickers: ObservedStickers
    pixels: Array
    spreads: Array
    variances: Array
    longest: Array


class Stickers(NamedTuple):
    """True and taught positions (n, 3) of the platform's stickers, normals (n, 3), and radius, m.

    Positions and normals are in the axes of the platform.
    """

    true: Array
    taught: Array
    normals: Array
    radius: float


class Limits(NamedTuple):
    """Limits for finding a sticker, and properties of the images.

    grazing        smallest cosine between the normal of a sticker and the direction to a camera
                   with which the estimator searches for the sticker
    thin_px        mean of the smallest accepted half axis of an ellipse, px
    thin_std_px    standard deviation of the smallest accepted half axis, px
    largest_gap    largest squared distance of the two rays in units of its variance
    clear          radius around a sticker, in its plane, within which no body may hide a point, m
    vignetting     vignetting of the lens
    line_variance  variance of the rays' distance that is due to errors of the rig, px²
    """

    grazing: float
    thin_px: float
    thin_std_px: float
    largest_gap: float
    clear: float
    vignetting: float
    line_variance: float


class StereoScene(NamedTuple):
    """Two cameras, and the scene in front of them.

    true_cameras                        cameras that form the images
    assumed_cameras                     cameras that the estimator assumes
    stickers                            stickers of the platform
    owners                              (n,), bodies of the stickers, here all 0 for the platform
    solids                              solids that can hide stickers
    noise                               noise of a sticker's centre
    limits                              limits for finding a sticker, and vignetting
    solver_limits                       limits of the solver of poses
    base_from_camera, camera_from_base  (4, 4), taught transforms
    """

    true_cameras: Cameras
    assumed_cameras: Cameras
    stickers: Stickers
    owners: Array
    solids: Solids
    noise: CentreNoise
    limits: Limits
    solver_limits: SolverLimits
    base_from_camera: Array
    camera_from_base: Array


@compiled
def image_stickers(
    side: int,
    scene: StereoScene,
    camera_from_bodies: Array,
    ends: Array,
    moving: bool,
    noise: Array,
    frame: Frame,
) -> None:
    """Fill the pixels and covariances of stickers in one image, and mark unseen ones as not used.

    ``side`` is 0 for the left and 1 for the right image. ``camera_from_bodies`` (b, 4, 4) belong to
    all solids, the platform first. If the platform is ``moving``, ``ends`` (2, 4, 4) are its
    camera_from_body at the beginning and the end of the exposure. ``noise`` (n, 3) are standard
    normal numbers: two for the centre, and one for the limit of thin ellipses. The left image must
    be the first, because it starts the mean variances of the pixels.
    """
    count = len(frame.variances)
    used = frame.stickers.used
    true_cameras = scene.true_cameras
    stickers = scene.stickers
    limits = scene.limits
    places = np.empty((count, 3))
    normals = np.empty((count, 3))
    hidden = np.empty(count, np.bool_)
    for n in range(count):
        transform_point(camera_from_bodies[0], stickers.true[n], 1.0, places[n])
        transform_point(camera_from_bodies[0], stickers.normals[n], 0.0, normals[n])
        used[n] = used[n] and faces(places[n], normals[n], 0.0)
    hidden_stickers(
        camera_from_bodies, places, normals, scene.owners, limits.clear, scene.solids, used, hidden
    )
    camera = true_cameras.intrinsics[side]
    point = np.empty(3)
    size = scene.noise.fit_size
    table = scene.noise.table
    first_values = scene.noise.first
    steps = scene.noise.steps
    by_light = scene.noise.by_light
    smear_step = scene.noise.settings.smear_step
    true = stickers.true
    pixels = frame.pixels[:, side]
    spreads = frame.spreads[:, side]
    for n in range(count):
        used[n] = used[n] and not hidden[n]
        if not used[n]:
            continue
        u, v, a, b, c, d = project(camera, places[n, 0], places[n, 1], places[n, 2])
        x, y, xx, xy, yy = disc_ellipse(places[n], normals[n], stickers.radius, camera)
        xx, xy, yy = distorted_root(xx, xy, yy, a, b, c, d)
        # The centre of the ellipse lies beside the image of the disc's centre (eccentricity).
        middle_u = u + camera[0] * (x - places[n, 0] / places[n, 2])
        middle_v = v + camera[1] * (y - places[n, 1] / places[n, 2])
        smear_u = 0.0
        smear_v = 0.0
        if moving:
            for end in range(2):
                transform_point(ends[end], true[n], 1.0, point)
                other_u, other_v, _, _, _, _ = project(camera, point[0], point[1], point[2])
                sign = 1.0 if end else -1.0
                smear_u += sign * other_u
                smear_v += sign * other_v
        path_length = length_of(smear_u, smear_v)
        frame.longest[0] = max(frame.longest[0], path_length)
        smallest = 0.5 * (xx + yy) - length_of(0.5 * (xx - yy), xy)
        used[n] = (
            smallest > limits.thin_px + limits.thin_std_px * noise[n, 2]
            and contains(middle_u, length_of(xx, xy), size)
            and contains(middle_v, length_of(xy, yy), size)
        )
        if not used[n]:
            continue
        light = light_at(camera, true_cameras.size[side], u, v, limits.vignetting)
        if path_length > smear_step:
            var_u, cov_uv, var_v = smeared(
                scene.noise, (xx, xy, yy), light, (middle_u, middle_v), (smear_u, smear_v)
            )
        else:
            var_u, cov_uv, var_v = tabulated(
                table, first_values, steps, by_light, xx, xy, yy, light
            )
        first = math.sqrt(var_u)
        # The Cholesky factor of the covariance transforms the unit noise.
        across = cov_uv / first
        # The estimator corrects for the eccentricity, so the noise is added to the image of the
        # sticker's centre.
        pixels[n, 0] = u + first * noise[n, 0]
        pixels[n, 1] = v + across * noise[n, 0] + math.sqrt(var_v - across * across) * noise[n, 1]
        spread = spreads[n]
        spread[0, 0] = var_u
        spread[0, 1] = cov_uv
        spread[1, 0] = cov_uv
        spread[1, 1] = var_v
        frame.variances[n] = 0.25 * (var_u + var_v) + (frame.variances[n] if side else 0.0)


@compiled
def observe(
    scene: StereoScene, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame
) -> None:
    """Fill the pixels and covariances in both images, and the mask of used stickers.

    ``poses`` (6, 6) of the platform are those in the middle, at the beginning and at the end of the
    left camera's exposure, then of the right camera's. ``bodies`` (b, 4, 4) are base_from_body of
    all solids except the platform. ``noise`` (2, n, 3) is that of ``image_stickers`` for both
    images. ``kept`` (n,) is False for stickers that are omitted at random. ``longest`` of the frame
    is filled, too.
    """
    # Both flags begin as results of comparisons, because ``image_stickers`` would be compiled once
    # more for the constant False.
    moving = poses[1, 0] != poses[2, 0]
    apart = poses[3, 0] != poses[0, 0]
    for i in range(1, 6):
        moving = moving or poses[1, i] != poses[2, i]
        apart = apart or poses[3, i] != poses[0, i]
    frame.longest[0] = 0.0
    for n in range(len(kept)):
        frame.stickers.used[n] = kept[n]
    platform = np.empty((4, 4))
    camera_from_bodies = np.empty((1 + len(bodies), 4, 4))
    ends = np.empty((2, 4, 4))
    for side in range(2):
        for end in range(2 if moving else 0):
            pose_transform(poses[3 * side + 1 + end], platform)
            multiply(scene.true_cameras.extrinsics[side], platform, ends[end])
        # Both cameras see the same pose unless the right camera exposes later.
        if side == 0 or moving or apart:
            pose_transform(poses[3 * side], platform)
        multiply(scene.true_cameras.extrinsics[side], platform, camera_from_bodies[0])
        for b in range(len(bodies)):
            multiply(scene.true_cameras.extrinsics[side], bodies[b], camera_from_bodies[1 + b])
        image_stickers(side, scene, camera_from_bodies, ends, moving, noise[side], frame)


@compiled
def shows(size: Array, u: float, v: float) -> bool:
    """Return True if a pixel lies inside an image of ``size`` (width, height)."""
    return -0.5 < u < size[0] - 0.5 and -0.5 < v < size[1] - 0.5


@compiled
def triangulate_stickers(scene: StereoScene, camera_from_platform: Array, frame: Frame) -> int:
    """Triangulate the used stickers, and return the number that the estimator would search for.

    Stickers are expected at ``camera_from_platform`` (4, 4). The estimator searches for those that
    face both cameras and whose centres are expected inside both images. Stickers are marked as not
    used if they are not searched for, or if their rays are too far apart.
    """
    seen = frame.stickers
    expected = np.empty(3)
    direction = np.empty(3)
    point = np.empty(3)
    normal = np.empty(3)
    scratch = np.empty((3, 6))
    cameras = scene.assumed_cameras
    limits = scene.limits
    searched = 0
    for n in range(len(seen.used)):
        transform_point(camera_from_platform, scene.stickers.taught[n], 1.0, expected)
        transform_point(camera_from_platform, scene.stickers.normals[n], 0.0, direction)
        found = True
        for side in range(2):
            transform_point(cameras.extrinsics[side], expected, 1.0, point)
            transform_point(cameras.extrinsics[side], direction, 0.0, normal)
            found = found and faces(point, normal, limits.grazing)
            u = frame.pixels[n, side, 0]
            v = frame.pixels[n, side, 1]
            # The detected centre of a used sticker is so near to the expected one that it serves
            # as well.
            if found and not seen.used[n]:
                u, v, _, _, _, _ = project(cameras.intrinsics[side], point[0], point[1], point[2])
            found = found and shows(cameras.size[side], u, v)
        searched += found
        if not seen.used[n]:
            continue
        if found:
            for i in range(3):
                seen.points[n, i] = expected[i]
            gap = triangulate_point(
                cameras, frame.pixels[n], frame.spreads[n], limits.line_variance, STEP_TOLERANCE,
                seen.points[n], scratch,
            )  # fmt: skip
            found = gap < limits.largest_gap
            seen.rays[n] = signed_distance(cameras, frame.pixels[n], seen.points[n], gap)
            from_entries(scratch[0], seen.informations[n])
            from_entries(scratch[1], seen.covariances[n])
            for i in range(3):
                seen.arms[n, i] = expected[i] - camera_from_platform[i, 3]
                seen.gaps[n, i] = seen.points[n, i] - expected[i]
        seen.used[n] = found
    return searched


@compiled
def measure_frame(
    scene: StereoScene, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame,
    pose: Array, spread: Array, verdict: Array,
) -> None:  # fmt: skip
    """Fill the measured ``pose`` (6,) and its covariance ``spread`` (6, 6).

    Both are NaN if the frame is lost. The first parameters are those of ``observe``. ``verdict``
    (COLUMNS,) is filled with the columns of ``solver_kernels``.
    """
    observe(scene, poses, bodies, noise, kept, frame)
    platform = np.empty((4, 4))
    camera_from_platform = np.empty((4, 4))
    covariance = np.empty((6, 6))
    pose_transform(poses[0], platform)
    multiply(scene.camera_from_base, platform, camera_from_platform)
    searched = triangulate_stickers(scene, camera_from_platform, frame)
    stickers = scene.stickers
    none = np.empty((0, 2, 3)), np.empty((0, 2, 6))
    outlines = Outlines(none[0], none[1], stickers.normals, stickers.radius, scene.assumed_cameras)
    # The poses in the middle of both exposures stand for the movement. Only its direction counts,
    # and only if the right camera exposes later.
    ends = np.empty((1, 2, 4, 4))
    for end in range(2):
        pose_transform(poses[3 * end], platform)
        multiply(scene.camera_from_base, platform, ends[0, end])
    images = Images(frame.pixels, frame.spreads, np.zeros((1, 2)), ends, scene.assumed_cameras)
    # For a literal, Numba would compile `solve` once more.
    row = int(np.int64(0))
    solve(
        frame.stickers, stickers.taught, outlines, scene.solver_limits, camera_from_platform,
        covariance, searched, images, row, np.empty((6, 6)), verdict,
    )  # fmt: skip
    if verdict[STATE] == MEASURED:
        multiply(scene.base_from_camera, camera_from_platform, platform)
        transform_pose(platform, pose)
        pose_covariance(pose, scene.base_from_camera, covariance, spread)
    else:
        pose[:] = np.nan
        spread[:] = np.nan


@compiled
def measure_frames(
    scene: StereoScene, poses: Array, bodies: Array, noise: Array, kept: Array, frame: Frame,
    found: Array, spreads: Array, verdicts: Array,
) -> float:  # fmt: skip
    """Apply ``measure_frame`` to N frames; return the longest path of a sticker, px.

    The frames have poses (N, 6, 6), noise (N, 2, n, 3) and kept (N, n). The bodies (b, 4, 4) are
    the same in all frames. Fills the measured poses ``found`` (N, 6), their covariances ``spreads``
    (N, 6, 6), and the verdicts (N, COLUMNS). ``frame`` is overwritten.
    """
    longest = 0.0
    for k in range(len(poses)):
        measure_frame(
            scene, poses[k], bodies, noise[k], kept[k], frame, found[k], spreads[k], verdicts[k]
        )
        longest = max(longest, frame.longest[0])
    return longest
