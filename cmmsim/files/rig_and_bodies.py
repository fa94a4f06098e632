"""Stereo rig and bodies with stickers, made from the content of a sensor file.

A rig is either nominal, with both cameras toed in to the target, or calibrated. A body has its
stickers on three machined planes. The planes are exact, but the positions of the stickers are
nominal: a sticker can lie up to about a millimetre from its nominal position.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import SensorFileError, ShapeError, TeachingError
from cmmsim.files.schema import (
    Body,
    Calibrated,
    Rig,
    RightFromLeft,
    SensorFile,
    StickerPlane,
    unit,
)
from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.plane_frame import PLANE_NAMES
from cmmsim.geometry.pose import Array, rigid, rotation_exp
from cmmsim.geometry.stereo_rig import StereoRig, placed_rig, toed_in_rig

# Number of points along each side of the image at which the distortion is checked.
BORDER_POINTS = 65
SHORTEST_BASELINE = 1e-3  # m
# Smallest volume that the unit normals of three planes must span. For a corner of a cube, it is 1.
SMALLEST_CORNER = 0.001


def rig_from_file(section: Rig) -> tuple[StereoRig, Array]:
    """Return the rig, and camera_from_base (4, 4), as the file states them.

    Raises SensorFileError, which names the wrong entry, if the rig is impossible.
    """
    position = np.array(section.position)
    target = np.array(section.target)
    # for a vertical line of sight, the horizontal axis of the cameras is not defined
    if np.linalg.norm(np.cross(target - position, [0.0, 0.0, 1.0])) < 1e-6:
        raise SensorFileError(
            f"rig.target {list(section.target)} must not be equal to rig.position "
            f"{list(section.position)}, or lie vertically above or below it"
        )
    middle = (0.5 * (section.width - 1), 0.5 * (section.height - 1))
    nominal = PinholeCamera(section.focal_px, *middle, section.width, section.height)
    rig, camera_from_base = toed_in_rig(nominal, section.baseline, position, target)
    rig = replace(
        rig,
        left=_camera(section.left, nominal, "left"),
        right=_camera(section.right, nominal, "right"),
    )
    if section.right_from_left is None:
        return rig, camera_from_base
    rig = replace(rig, right_from_left=_right_from_left(section.right_from_left))
    return rig, placed_rig(rig, position, target)


def lens_from_file(file: SensorFile) -> Optics:
    """Return the optics of both lenses."""
    lens = file.lens
    distance = float(np.linalg.norm(np.subtract(file.rig.position, file.rig.target)))
    x, y = lens.ghost_offset_px
    focus = lens.focus or distance
    return Optics(lens.psf_px, lens.vignetting, lens.aperture, focus, lens.ghost, (int(x), int(y)))


def _camera(calibrated: Calibrated | None, nominal: PinholeCamera, name: str) -> PinholeCamera:
    """Return the calibrated camera, or the nominal one if the file has no calibration.

    Raises SensorFileError if the distortion has no inverse in some part of the image.
    """
    if calibrated is None:
        return nominal
    focal_x, focal_y = calibrated.focal_px
    size = (nominal.width, nominal.height)
    lens = Distortion(*calibrated.distortion)
    camera = PinholeCamera(focal_x, *calibrated.centre_px, *size, focal_y / focal_x, lens)
    _require_whole_image(camera, name)
    return camera


def _require_whole_image(camera: PinholeCamera, name: str) -> None:
    """Raise SensorFileError if the distortion has no inverse in some part of the image."""
    x = np.linspace(-0.5, camera.width - 0.5, BORDER_POINTS)
    y = np.linspace(-0.5, camera.height - 0.5, BORDER_POINTS)
    border = np.concatenate(
        [np.column_stack([x, np.full_like(x, k)]) for k in (y[0], y[-1])]
        + [np.column_stack([np.full_like(y, k), y]) for k in (x[0], x[-1])]
    )
    valid = camera.undistort(border)[1]
    if not valid.all():
        raise SensorFileError(
            f"rig.{name}.distortion: the image folds back before pixel "
            f"{np.round(border[~valid][0]).tolist()}, {camera.distortion.fold_radius:.4g} focal "
            "lengths from the optical axis"
        )


def _right_from_left(section: RightFromLeft) -> Array:
    """Return right_from_left (4, 4). Raises SensorFileError for an impossible pose."""
    right_from_left = rigid(rotation_exp(np.array(section.rotation_vector)), section.translation)
    right_centre = -right_from_left[:3, :3].T @ right_from_left[:3, 3]
    if np.linalg.norm(right_centre) < SHORTEST_BASELINE:
        raise SensorFileError(
            f"rig.right_from_left.translation: the cameras must be at least {SHORTEST_BASELINE} m "
            f"apart, got {list(section.translation)}"
        )
    if right_centre[0] <= 0.0 or right_from_left[2, 2] <= 0.0:
        shift = ", ".join(f"{value:.4g}" for value in section.translation)
        turn = ", ".join(f"{value:.4g}" for value in section.rotation_vector)
        raise SensorFileError(
            "rig.right_from_left: the right camera must stand to the right of the left camera "
            "(translation x below zero if both look in the same direction) and look in about the "
            f"same direction, got translation [{shift}] m and rotation_vector [{turn}] rad"
        )
    return right_from_left


@dataclass(frozen=True)
class MarkedBody:
    """Body with planes and nominal sticker positions, in body axes.

    normals      (3, 3), unit normals n of the planes A, B, C
    offsets      (3,), offsets d of the planes n . p = d, m
    sticker_ids  (n,), names of the stickers, such as "A1"
    plane_index  (n,), plane of each sticker, 0 to 2
    nominal      (n, 3), nominal positions, m
    in_plane     (n, 3, 2), u and v axes of each sticker's plane
    """

    name: str
    normals: Array
    offsets: Array
    sticker_ids: NDArray[np.str_]
    plane_index: NDArray[np.int_]
    nominal: Array
    in_plane: Array

    def __post_init__(self) -> None:
        if self.nominal.shape != (len(self.sticker_ids), 3) or self.normals.shape != (3, 3):
            raise ShapeError(
                f"body {self.name}: {len(self.sticker_ids)} stickers but places "
                f"{self.nominal.shape}"
            )
        for array in (self.normals, self.offsets, self.plane_index, self.nominal, self.in_plane):
            array.setflags(write=False)

    @property
    def sticker_normals(self) -> Array:
        """Outward normals (n, 3) at the stickers."""
        return self.normals[self.plane_index]

    def selected(self, stickers: NDArray[np.int_]) -> "MarkedBody":
        """Return the body with only some of its stickers, which are given by their indices."""
        return replace(
            self,
            sticker_ids=self.sticker_ids[stickers],
            plane_index=self.plane_index[stickers],
            nominal=self.nominal[stickers],
            in_plane=self.in_plane[stickers],
        )


def marked_body(name: str, body: Body) -> MarkedBody:
    """Return the body that a section of a sensor file describes.

    Raises SensorFileError for a normal of length zero, and for an ``across`` along the normal.
    """
    planes = [getattr(body.planes, plane) for plane in PLANE_NAMES]
    normals = np.stack([unit(p.normal) for p in planes])
    offsets = np.array([n @ np.array(p.point) for n, p in zip(normals, planes, strict=True)])
    counts = [len(p.stickers) for p in planes]
    axes = [_plane_axes(p) for p in planes]
    nominal = [
        np.array(p.point) + np.array(p.stickers) @ a.T for p, a in zip(planes, axes, strict=True)
    ]
    ids = [
        f"{plane}{k + 1}"
        for plane, count in zip(PLANE_NAMES, counts, strict=True)
        for k in range(count)
    ]
    return MarkedBody(
        name,
        normals,
        offsets,
        np.array(ids),
        np.repeat(np.arange(3), counts),
        np.concatenate(nominal),
        np.repeat(np.stack(axes), counts, axis=0),
    )


def require_corner(body: MarkedBody) -> None:
    """Raise TeachingError unless the planes of a body meet in one point."""
    volume = abs(float(np.linalg.det(body.normals)))
    if volume < SMALLEST_CORNER:
        raise TeachingError(
            f"{body.name}: planes A, B and C do not meet in one point, so no frame can be taught: "
            f"their unit normals span a volume of {volume:.1g}, but at least {SMALLEST_CORNER:g} "
            "is needed"
        )


def _plane_axes(plane: StickerPlane) -> Array:
    """Return the u and v axes (3, 2) of a plane as columns."""
    normal = unit(plane.normal)
    across = np.array(plane.across)
    u = unit(across - (across @ normal) * normal)
    return np.column_stack([u, np.cross(normal, u)])
