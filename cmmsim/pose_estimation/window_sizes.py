"""How large the windows are in which stickers are looked for: large enough for the largest image of a sticker.

That is the image of a sticker in the nearest place of work, which is taken for a fifth nearer than the rig's target, or
of one that both cameras see on base and platform at teaching.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cmmsim.files.marked_body import MarkedBody
from cmmsim.geometry.outlines import sticker_outlines
from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.pose_estimation.observation import faces_camera
from cmmsim.pose_estimation.teaching import TeachingPlan

ROOM = 1.35  # half the side of what is fitted over a sticker's radius at the rig's target
SMALLEST_ROOM_PX = 0.7  # on each side of the largest sticker at teaching: half a pixel goes into rounding
SMALLEST_FIT, SMALLEST_BLURRED_FIT = 12, 14  # px
BLUR_ROOM = 1.0  # px on each side, at least, for what point spread and exposure blur
WINDOW_SHARE = 7 / 6  # side of a window over that of the part that is fitted


@dataclass(frozen=True)
class WindowSizes:
    """Sides in px of windows and of the part around the bright spot that is fitted; growth: of what is fitted, over
    what the smallest stickers get."""

    window: int
    fit: int
    growth: float

    def plan(self) -> TeachingPlan:
        """Teaching with windows that have grown alike."""
        plan = TeachingPlan()
        sizes = {
            name: 2 * round(0.5 * self.growth * getattr(plan, name))
            for name in ("base_window", "first_window", "platform_window")
        }
        return replace(plan, **sizes)


def window_sizes(target_px: float, largest_px: float, psf_px: float, blurred: bool) -> WindowSizes:
    """Sizes for stickers whose radius looks ``target_px`` large at the rig's target and ``largest_px`` at teaching.

    Parameters: psf_px: sigma of the point spread; blurred: by it or by a moving platform.
    """
    smallest, blur = (SMALLEST_BLURRED_FIT, max(BLUR_ROOM, psf_px)) if blurred else (SMALLEST_FIT, 0.0)
    reach = max(ROOM * target_px, largest_px + SMALLEST_ROOM_PX)
    fit = max(smallest, 2 * int(np.ceil(reach + blur)))
    return WindowSizes(2 * int(0.5 * WINDOW_SHARE * fit), fit, fit / smallest)


def radius_at(rig: StereoRig, camera_from_base: Array, target: Array, radius: float) -> float:
    """Radius in px of a sticker of ``radius`` m that faces the nearer camera at ``target`` (3,) m, base axes."""
    distances = [float(np.linalg.norm(apply(move @ camera_from_base, target))) for move in rig.from_camera]
    return max(
        radius * float(camera.focal_lengths.max()) / distance
        for camera, distance in zip(rig.cameras, distances, strict=True)
    )


def largest_radius(rig: StereoRig, camera_from_body: Array, body: MarkedBody, radius: float) -> float:
    """Longest half axis in px of the stickers of a body that both cameras see; 0 where there is none."""
    normals = body.sticker_normals
    seen = np.all(rig.project(apply(camera_from_body, body.nominal))[1], axis=0)
    for move in rig.from_camera:
        placed = move @ camera_from_body
        seen &= faces_camera(apply(placed, body.nominal), normals @ placed[:3, :3].T)
    _, shapes = sticker_outlines(rig, camera_from_body, body.nominal[seen], normals[seen], radius)
    return float(np.linalg.eigvalsh(shapes).max(initial=0.0))
