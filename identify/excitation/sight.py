"""How near stickers come to being out of the sight of a camera, as CasADi expressions of the pose."""

import casadi as ca
import numpy as np

from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.pose_estimation.observation import GRAZING
from cmmsim.visibility import EDGE_PX, SightLines
from dynamics.kinematics.rotation import rotation_matrix
from identify.arrays import Array
from identify.errors import TrajectoryError

STICKERS_A_PLANE = 4
"""Stickers of each plane that both cameras must be able to look for at every pose; all where it has fewer."""

PLANES = "ABC"


def required_stickers(sight: SightLines, home: Array) -> list[int]:
    """The stickers, STICKERS_A_PLANE a plane, that are to stay visible: those that face both cameras best at home.

    Raises TrajectoryError, naming the plane, where not so many can be looked for even at home.
    """
    uses = np.array(_functions(sight, range(len(sight.platform.sticker_ids)))(home)).reshape(-1, 2, 3)
    worst, visible = np.abs(uses).max(axis=(1, 2)), sight.visible(home)
    chosen: list[int] = []
    for index, plane in enumerate(PLANES):
        on_plane = sight.platform.plane_index == index
        able, needed = np.flatnonzero(visible & on_plane), min(STICKERS_A_PLANE, int(on_plane.sum()))
        if len(able) < needed:
            raise TrajectoryError(
                f"visibility: both cameras can look for {len(able)} stickers of plane {plane} at the home pose, "
                f"{needed} are needed"
            )
        chosen += able[np.argsort(worst[able], kind="stable")][:needed].tolist()
    return chosen


def sight_uses(sight: SightLines, stickers: list[int], pose: ca.SX) -> ca.SX:
    """Six rows a sticker, for each camera: share used of grazing incidence, and of the image across and up.

    Beyond +-1 the camera cannot look for the sticker. Lens distortion is left out.
    """
    platform, rows = sight.platform, []
    rotation = rotation_matrix(pose[3:6])
    for k in stickers:
        place = rotation @ platform.nominal[k] + pose[0:3]
        normal = rotation @ platform.sticker_normals[k]
        for camera, move in zip(sight.rig.cameras, sight.cameras_from_base, strict=True):
            seen = move[:3, :3] @ place + move[:3, 3]
            facing = -ca.dot(seen, move[:3, :3] @ normal) / ca.norm_2(seen)
            pixel = seen[0:2] / seen[2] * camera.focal_lengths + camera.centre
            half = np.array([camera.width - 1, camera.height - 1]) / 2
            rows += [(1 - facing) / (1 - GRAZING), (pixel - half) / (half - EDGE_PX)]
    return ca.vertcat(*rows)


def within_sight(sight: SightLines, stickers: list[int], home: Array, box: Array) -> bool:
    """Whether the stickers stay in sight wherever the platform goes within the box (6,) [m, rad] about home.

    By bounds on how far a sticker moves and turns, so that no pose has to be tried; False where they do not tell.
    """
    turn, uses = float(box[3:].sum()), np.array(_functions(sight, stickers)(home)).reshape(-1, 2, 3)
    places = apply(pose_to_transform(home), sight.platform.nominal[stickers])
    shifts = np.linalg.norm(box[:3]) + turn * np.linalg.norm(sight.platform.nominal[stickers], axis=1)
    for camera, move, use in zip(sight.rig.cameras, sight.cameras_from_base, uses.swapaxes(0, 1), strict=True):
        seen = apply(move, places)
        nearest = seen[:, 2] - shifts
        if (nearest <= 0).any():
            return False
        turned = turn + np.arcsin(np.minimum(1.0, shifts / np.linalg.norm(seen, axis=1)))
        angle = np.arccos(1 - use[:, 0] * (1 - GRAZING)) + turned
        moved = (shifts / nearest)[:, None] * (1 + np.abs(seen[:, :2] / seen[:, 2:])) * camera.focal_lengths
        half = np.array([camera.width - 1, camera.height - 1]) / 2 - EDGE_PX
        if (angle >= np.arccos(GRAZING)).any() or (np.abs(use[:, 1:]) + moved / half >= 1).any():
            return False
    return True


def _functions(sight: SightLines, stickers: range | list[int]) -> ca.Function:
    pose = ca.SX.sym("pose", 6)
    return ca.Function("sight_uses", [pose], [sight_uses(sight, list(stickers), pose)])
