"""Compiled covariance of a pose due to errors that the stickers of an image share.

Such errors look like a movement of the body in part, but they also leave other traces:

- If the right camera exposes later than the left one, or rows of pixels one after another, stickers
  of a moving body are displaced along their movement. Only one number is unknown, the delay. A part
  of the displacement looks like a movement of the body. The rest remains in the residuals, from
  which the delay is estimated.
- If a lens blurs more than it is known to, its point spread can lean to one side. All centres in
  the image then shift by the same vector. The size of this vector is estimated from the blur.

The standard deviation of each error is proportional to the part of the estimated delay or blur that
exceeds a limit. Noise rarely exceeds the limit, so clean frames lose little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, pose_slopes, project, transformed, weigh
from cmmsim.geometry.transform_kernels import transform_point

# Number of delays: one of the right camera, and one from row to row.
DELAYS = 2
# Number of common shifts: one along x and one along y in each image.
SHIFTS = 4
# Inverse variance of a delay before the fit, in frame periods^-2. It keeps the variance finite if
# the stickers do not determine a delay. The row delay is that over the whole height of the image.
KNOWN_DELAY = 1.0
# Largest delay that noise explains, in its standard deviations. The excess over it, times
# DELAY_SHARE, becomes the standard deviation of the delay. For a body that moves along the line
# between the cameras, a delay changes the residuals up to four times less than the pose. A limit of
# 2.5 would detect smaller delays, but doubles the variance of clean frames that move this way.
LARGEST_DELAY = 3.0
DELAY_SHARE = 2.0


class Images(NamedTuple):
    """Both images of one frame or of several frames.

    pixels   (n, 2, 2), centres of n stickers in both images, without eccentricity, px
    spreads  (n, 2, 2, 2), covariances of the centres, px²
    shifts   (f, 2), standard deviation of the common shift of centres in each image, px
    ends     (f, 2, 4, 4), camera_from_body half a frame period before and after the middle of a
             frame; equal if the movement is not known
    cameras  cameras as the estimator knows them
    """

    pixels: Array
    spreads: Array
    shifts: Array
    ends: Array
    cameras: Cameras


@compiled
def shared_errors(
    used: Array, places: Array, arms: Array, images: Images, frame: int, transform: Array,
    covariance: Array, exact: bool, spread: Array,
) -> None:  # fmt: skip
    """Add the covariance of a pose due to shared errors to ``spread`` (6, 6).

    ``transform`` (4, 4) is the fitted camera_from_body, and ``covariance`` (6, 6) that of its
    noise. The n stickers have taught ``places`` and ``arms`` (n, 3). ``frame`` is the row of the
    frame in the shifts and ends of ``images``. Delays are tested only if the rig is ``exact``.
    """
    first = images.ends[frame, 0]
    last = images.ends[frame, 1]
    moving = False
    for i in range(3):
        for j in range(4):
            moving = moving or first[i, j] != last[i, j]
    moving = moving and exact
    if not (moving or images.shifts[frame, 0] > 0.0 or images.shifts[frame, 1] > 0.0):
        return
    cameras = images.cameras
    cross_informations = np.zeros((SHIFTS + DELAYS, 6))
    delay_informations = np.zeros(DELAYS)
    delay_sums = np.zeros(DELAYS)
    point = np.empty(3)
    before = np.empty(3)
    after = np.empty(3)
    slope = np.empty((2, 6))
    weighted_slopes = np.empty((6, 2))
    weight = np.empty((2, 2))
    moved = np.zeros(2)
    for n in range(len(used)):
        if not used[n]:
            continue
        transform_point(transform, places[n], 1.0, point)
        if moving:
            transform_point(first, places[n], 1.0, before)
            transform_point(last, places[n], 1.0, after)
        for side in range(2):
            camera = cameras.intrinsics[side]
            move = cameras.extrinsics[side]
            u, v = pose_slopes(camera, move, point, arms[n], slope)
            weigh(slope, images.spreads[n, side], weight, weighted_slopes)
            for i in range(6):
                for j in range(2):
                    cross_informations[2 * side + j, i] += weighted_slopes[i, j]
            if not moving:
                continue
            x, y, z = transformed(move, before)
            u_0, v_0, _, _, _, _ = project(camera, x, y, z)
            x, y, z = transformed(move, after)
            u_1, v_1, _, _, _, _ = project(camera, x, y, z)
            moved[0] = u_1 - u_0
            moved[1] = v_1 - v_0
            off_x = images.pixels[n, side, 0] - u
            off_y = images.pixels[n, side, 1] - v
            along = 0.0
            length = 0.0
            for j in range(2):
                weighted = weight[0, j] * moved[0] + weight[1, j] * moved[1]
                along += weighted * (off_y if j else off_x)
                length += weighted * moved[j]
            row_delay = v / cameras.size[side, 1] - 0.5
            for k in range(DELAYS):
                delay = row_delay if k else float(side)
                delay_sums[k] += delay * along
                delay_informations[k] += delay * delay * length
                for i in range(6):
                    cross_informations[SHIFTS + k, i] += delay * (
                        weighted_slopes[i, 0] * moved[0] + weighted_slopes[i, 1] * moved[1]
                    )
    for k in range(SHIFTS + DELAYS):
        change = covariance @ cross_informations[k]
        std = 0.0
        if k < SHIFTS:
            std = images.shifts[frame, k // 2]
        elif moving:
            # The fitted pose absorbs a part of the displacement.
            information = delay_informations[k - SHIFTS] + KNOWN_DELAY
            for i in range(6):
                information -= cross_informations[k, i] * change[i]
            deviation = 1.0 / np.sqrt(information)
            beyond = abs(delay_sums[k - SHIFTS]) * deviation - LARGEST_DELAY
            std = DELAY_SHARE * deviation * max(beyond, 0.0)
        if std > 0.0:
            for i in range(6):
                for j in range(6):
                    spread[i, j] += std * std * change[i] * change[j]
