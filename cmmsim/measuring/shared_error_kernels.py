"""Compiled covariance of a pose for errors that the stickers of an image share.

Noise does not tell such errors from a movement of the body, but they leave other traces:

- If the right camera exposes later than the left one, or rows of pixels one after another, stickers
  of a moving body are displaced along their movement. The displacement is known but for one number,
  the delay. A part of it looks like a movement of the body. The rest remains in the residuals and
  determines the delay.
- If a lens blurs more than it is known to, its point spread can lean to one side. All centres in
  the image then shift by the same vector. The blur tells the size of this vector.

A delay that noise does not explain, and a blur beyond that of the known lens, become standard
deviations of these errors. Only the part beyond a limit counts, so clean frames lose little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, pose_slopes, project, transformed, weigh
from cmmsim.geometry.transform_kernels import transform_point

# A delay of the right camera, and one from row to row.
DELAYS = 2
# Common shifts of both images, along x and y.
SHIFTS = 4
# Inverse square of the largest delay, in frame periods. Rows count as delayed by their distance
# from the middle row, in heights of the image.
KNOWN_DELAY = 1.0
# Largest delay that noise explains, in its standard deviations. What it is beyond this, times the
# share, is the standard deviation of the delay. A movement along the line between the cameras
# leaves up to four times less in the residuals than in the pose. A limit of 2.5 would notice more
# of it, but doubles the variance of clean frames that move along this line.
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
    used: Array, places: Array, arms: Array, images: Images, frame: int, place: Array,
    covariance: Array, exact: bool, spread: Array,
) -> None:  # fmt: skip
    """Add the covariance of a pose due to shared errors to ``spread`` (6, 6).

    ``images`` have the used stickers with taught ``places`` and ``arms`` (n, 3), and ``frame`` is
    the row of their shifts and ends. ``place`` (4, 4) is the fitted pose, and ``covariance`` (6, 6)
    that of its noise. Delays are tested only if the rig is known exactly.
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
    pushes = np.zeros((SHIFTS + DELAYS, 6))
    known = np.zeros(DELAYS)
    right = np.zeros(DELAYS)
    point = np.empty(3)
    before = np.empty(3)
    after = np.empty(3)
    slope = np.empty((2, 6))
    pushed = np.empty((6, 2))
    weight = np.empty((2, 2))
    moved = np.zeros(2)
    for n in range(len(used)):
        if not used[n]:
            continue
        transform_point(place, places[n], 1.0, point)
        if moving:
            transform_point(first, places[n], 1.0, before)
            transform_point(last, places[n], 1.0, after)
        for side in range(2):
            camera = cameras.intrinsics[side]
            move = cameras.extrinsics[side]
            u, v = pose_slopes(camera, move, point, arms[n], slope)
            weigh(slope, images.spreads[n, side], weight, pushed)
            for i in range(6):
                for j in range(2):
                    pushes[2 * side + j, i] += pushed[i, j]
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
                by = weight[0, j] * moved[0] + weight[1, j] * moved[1]
                along += by * (off_y if j else off_x)
                length += by * moved[j]
            late = v / cameras.size[side, 1] - 0.5
            for k in range(DELAYS):
                delay = late if k else float(side)
                right[k] += delay * along
                known[k] += delay * delay * length
                for i in range(6):
                    pushes[SHIFTS + k, i] += delay * (
                        pushed[i, 0] * moved[0] + pushed[i, 1] * moved[1]
                    )
    for k in range(SHIFTS + DELAYS):
        change = covariance @ pushes[k]
        size = 0.0
        if k < SHIFTS:
            size = images.shifts[frame, k // 2]
        elif moving:
            # A part of the displacement is taken up by the pose.
            information = known[k - SHIFTS] + KNOWN_DELAY
            for i in range(6):
                information -= pushes[k, i] * change[i]
            deviation = 1.0 / np.sqrt(information)
            beyond = abs(right[k - SHIFTS]) * deviation - LARGEST_DELAY
            size = DELAY_SHARE * deviation * max(beyond, 0.0)
        if size > 0.0:
            for i in range(6):
                for j in range(6):
                    spread[i, j] += size * size * change[i] * change[j]
