"""The stereo rig that a sensor file describes: nominal and toed in, or as calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmmsim.errors import SensorFileError
from cmmsim.files.schema import Calibrated, Rig, RightFromLeft
from cmmsim.geometry.camera import Distortion, PinholeCamera
from cmmsim.geometry.pose import Array, rotation_exp
from cmmsim.geometry.stereo_rig import StereoRig, placed_rig, toed_in_rig

BORDER_POINTS = 65  # along each side of the image, asked whether the distortion model holds there
SHORTEST_BASELINE = 1e-3  # m


def rig_from_file(section: Rig) -> tuple[StereoRig, Array]:
    """The rig and the true camera_from_base (4,4). Raises SensorFileError naming the camera at fault."""
    position, target = np.array(section.position), np.array(section.target)
    if np.linalg.norm(np.cross(target - position, [0.0, 0.0, 1.0])) < 1e-6:
        raise SensorFileError(
            f"rig.target {list(section.target)} must not stand straight above or below, or at, "
            f"rig.position {list(section.position)}"
        )
    middle = (0.5 * (section.width - 1), 0.5 * (section.height - 1))
    nominal = PinholeCamera(section.focal_px, *middle, section.width, section.height)
    rig, camera_from_base = toed_in_rig(nominal, section.baseline, position, target)
    rig = replace(rig, left=_camera(section.left, nominal, "left"), right=_camera(section.right, nominal, "right"))
    if section.right_from_left is None:
        return rig, camera_from_base
    rig = replace(rig, right_from_left=_right_from_left(section.right_from_left))
    return rig, placed_rig(rig, position, target)


def _camera(calibrated: Calibrated | None, nominal: PinholeCamera, name: str) -> PinholeCamera:
    if calibrated is None:
        return nominal
    focal_x, focal_y = calibrated.focal_px
    camera = replace(
        nominal,
        focal_px=focal_x,
        centre_x_px=calibrated.centre_px[0],
        centre_y_px=calibrated.centre_px[1],
        aspect=focal_y / focal_x,
        distortion=Distortion(*calibrated.distortion),
    )
    _require_whole_image(camera, name)
    return camera


def _require_whole_image(camera: PinholeCamera, name: str) -> None:
    """Raise SensorFileError where a part of the image is beyond the fold of the distortion."""
    x, y = np.linspace(-0.5, camera.width - 0.5, BORDER_POINTS), np.linspace(-0.5, camera.height - 0.5, BORDER_POINTS)
    border = np.concatenate(
        [np.column_stack([x, np.full_like(x, k)]) for k in (y[0], y[-1])]
        + [np.column_stack([np.full_like(y, k), y]) for k in (x[0], x[-1])]
    )
    found = camera.undistort(border)[1]
    if not found.all():
        raise SensorFileError(
            f"rig.{name}.distortion: the image folds back before pixel {np.round(border[~found][0]).tolist()}, "
            f"{camera.distortion.fold_radius:.4g} focal lengths from the optical axis"
        )


def _right_from_left(section: RightFromLeft) -> Array:
    right_from_left = np.eye(4)
    right_from_left[:3, :3] = rotation_exp(np.array(section.rotation_vector))
    right_from_left[:3, 3] = section.translation
    right_centre = -right_from_left[:3, :3].T @ right_from_left[:3, 3]
    if np.linalg.norm(right_centre) < SHORTEST_BASELINE:
        raise SensorFileError(
            f"rig.right_from_left.translation: the cameras must be at least {SHORTEST_BASELINE} m "
            f"apart, got {list(section.translation)}"
        )
    if right_centre[0] <= 0.0 or right_from_left[2, 2] <= 0.0:
        raise SensorFileError(
            "rig.right_from_left: the right camera must stand on the right of the left one (translation x below zero "
            f"where both look the same way) and look its way, got {section.model_dump()}"
        )
    return right_from_left
