"""The poses through which a moving platform goes during one exposure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

LARGEST_STEP_PX = 0.3  # between two sub-frames no sticker moves farther
MOST_SUB_FRAMES = 500


def sub_frame_poses(pose: Array, pose_rate: Array, exposure: float, sticker_pixels: Callable[[Array], Array]) -> Array:
    """Poses (m, 6) whose mean image is that of the whole exposure, by the midpoint rule.

    Parameters: pose (6,) in the middle of the exposure; pose_rate (6,) its time derivative, which is constant; exposure
    s; sticker_pixels: places (..., 2) px of all stickers in the images at a pose. Raises CmmError where the stickers
    move farther than an image can show.
    """
    half = 0.5 * exposure * pose_rate
    moved = float(np.linalg.norm(sticker_pixels(pose + half) - sticker_pixels(pose - half), axis=-1).max())
    count = max(1, int(np.ceil(moved / LARGEST_STEP_PX)))
    if count > MOST_SUB_FRAMES:
        raise CmmError(
            f"a sticker moves {moved:.0f} px during the exposure of {exposure:g} s at pose rate "
            f"{pose_rate.tolist()}, at most {MOST_SUB_FRAMES * LARGEST_STEP_PX:.0f} px can be drawn"
        )
    share = (2.0 * np.arange(count) + 1.0) / count - 1.0
    return pose + share[:, None] * half
