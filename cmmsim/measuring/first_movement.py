"""Movement of a body from a single frame whose rows of pixels are exposed one after another.

A sticker in a later row is seen later. Its place in the image therefore depends on the pose of the
body, and on its movement in the meantime. Both are fitted to all stickers together, to first order.
"""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.pose import Array, apply, rigid, rotation_exp, skew
from cmmsim.measuring.sticker_windows import StickerWindows

# Fewest stickers from which a movement is found.
FEWEST = 6


def frame_ends_of(read: StickerWindows) -> tuple[tuple[Array, Array] | None, float]:
    """Return camera_from_body (4, 4) half a frame period before and after the middle of a frame.

    The second result is the factor on the covariance of a pose whose movement is not known. The
    ends are None if fewer than FEWEST stickers are found. ``read`` has one exposure.
    """
    rig = read.observer.rig
    detected = read.found or read.centres()
    good = np.all(detected.good.reshape(2, -1), axis=0)
    if np.count_nonzero(good) < FEWEST:
        return None, 1.0
    move = read.camera_from_body.reshape(4, 4)
    points = apply(move, read.places[good])
    middle = points.mean(axis=0)
    slopes = rig.derivatives(points)[0].reshape(2, len(points), 2, 3)
    turned = -slopes @ skew(points - middle)
    by_pose = np.concatenate([slopes, turned], axis=-1)
    late = read.late()[:, good]
    columns = np.concatenate([by_pose, late[..., None, None] * by_pose], axis=-1)
    seen = (detected.centres.reshape(2, -1, 2) - read.offsets)[:, good]
    away = seen - rig.project(points)[0]
    flat = columns.reshape(-1, 12)
    found = np.linalg.lstsq(flat, away.ravel(), rcond=None)[0]
    known = flat.T @ flat
    # Ratio of the variance of a pose that is fitted with the movement to that of a pose without it,
    # as a mean over the directions of the pose.
    factor = float(np.trace(known[:6, :6] @ np.linalg.pinv(known)[:6, :6])) / 6.0
    ends = []
    for share in (-0.5, 0.5):
        small = found[:6] + share * found[6:]
        turn = rotation_exp(small[3:])
        ends.append(rigid(turn, middle + small[:3] - turn @ middle) @ move)
    return (ends[0], ends[1]), factor
