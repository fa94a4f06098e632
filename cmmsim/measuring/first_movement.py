"""Movement of a body from a single frame of a camera with a rolling shutter.

The rows of pixels are exposed one after another, so a sticker in a later row is seen later. Its
place in the image depends on the body's pose when the middle row is exposed, and on the movement
between the exposures of the middle row and of the sticker's row. Pose and movement are fitted to
all stickers together, to first order.
"""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.pose import Array, apply, rigid, rotation_exp, skew
from cmmsim.measuring.sticker_windows import StickerWindows

FEWEST = 6  # fewest stickers from which a movement is estimated


def frame_ends_of(read: StickerWindows) -> tuple[tuple[Array, Array] | None, float]:
    """Return camera_from_body (4, 4) half a frame period before and after the middle of a frame.

    The second result is the factor by which the covariance of the pose grows, because the movement
    is estimated from the same stickers. The results are None and 1 for fewer than FEWEST stickers.
    ``read`` must have one exposure.
    """
    rig = read.observer.rig
    detected = read.found or read.centres()
    good = np.all(detected.good.reshape(2, -1), axis=0)
    if np.count_nonzero(good) < FEWEST:
        return None, 1.0
    camera_from_body = read.camera_from_body.reshape(4, 4)
    points = apply(camera_from_body, read.places[good])
    middle = points.mean(axis=0)
    slopes = rig.derivatives(points)[0].reshape(2, len(points), 2, 3)
    by_rotation = -slopes @ skew(points - middle)
    by_pose = np.concatenate([slopes, by_rotation], axis=-1)
    delays = read.row_delays()[:, good]
    slopes_of_both = np.concatenate([by_pose, delays[..., None, None] * by_pose], axis=-1)
    centres = (detected.centres.reshape(2, -1, 2) - read.offsets)[:, good]
    residuals = centres - rig.project(points)[0]
    jacobian = slopes_of_both.reshape(-1, 12)
    solution = np.linalg.lstsq(jacobian, residuals.ravel(), rcond=None)[0]
    information = jacobian.T @ jacobian
    # Variance of the pose if the movement is fitted too, divided by the variance if it is not, as a
    # mean over the six directions of the pose.
    factor = float(np.trace(information[:6, :6] @ np.linalg.pinv(information)[:6, :6])) / 6.0
    ends = []
    for delay in (-0.5, 0.5):
        change = solution[:6] + delay * solution[6:]
        rotation = rotation_exp(change[3:])
        ends.append(rigid(rotation, middle + change[:3] - rotation @ middle) @ camera_from_body)
    return (ends[0], ends[1]), factor
