"""Two cameras on one rigid bar.

The camera frame C of the sensor is the frame of the left camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cmmsim.errors import ShapeError
from cmmsim.geometry.camera import INTRINSIC_NAMES, PinholeCamera, camera_from
from cmmsim.geometry.lens_distortion import NDArrayBool
from cmmsim.geometry.pose import Array, apply, invert, rigid, rotation_exp, rotation_log

if TYPE_CHECKING:
    from cmmsim.geometry.camera_kernels import Cameras

PLACE_NAMES = ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")
PARAMETER_NAMES = (
    *(f"{side}.{name}" for side in ("left", "right") for name in INTRINSIC_NAMES),
    *(f"right_from_left.{name}" for name in PLACE_NAMES),
)
"""Names of a rig's parameters: the intrinsics of the left and the right camera, then the
translation and the rotation vector of ``right_from_left``.
"""


@dataclass(frozen=True)
class StereoRig:
    """Two cameras on one rigid bar.

    Parameters
    ----------
    left, right : PinholeCamera
        The cameras.
    right_from_left : ndarray, shape (4, 4)
        Transform from the axes of the left camera into those of the right camera. The array
        becomes read-only.

    Raises
    ------
    ShapeError
        If ``right_from_left`` is not (4, 4).

    Examples
    --------
    >>> camera = PinholeCamera(1000.0, 319.5, 239.5, 640, 480)
    >>> StereoRig(camera, camera, rigid(np.eye(3), (-0.3, 0.0, 0.0)))
    StereoRig(640 x 480 px and 640 x 480 px, 0.3 m apart)
    """

    left: PinholeCamera
    right: PinholeCamera
    right_from_left: Array

    def __post_init__(self) -> None:
        if self.right_from_left.shape != (4, 4):
            raise ShapeError(f"right_from_left must be (4,4), got {self.right_from_left.shape}")
        self.right_from_left.setflags(write=False)

    def __repr__(self) -> str:
        sizes = " and ".join(f"{camera.width} x {camera.height} px" for camera in self.cameras)
        return f"StereoRig({sizes}, {np.linalg.norm(self.right_from_left[:3, 3]):.4g} m apart)"

    @property
    def cameras(self) -> tuple[PinholeCamera, PinholeCamera]:
        """Left and right camera."""
        return self.left, self.right

    @property
    def from_camera(self) -> tuple[Array, Array]:
        """Transforms (4, 4) from the camera frame C into the axes of each camera, left first."""
        return np.eye(4), self.right_from_left

    @property
    def right_centre(self) -> Array:
        """Centre (3,) of the right camera in the camera frame C, m."""
        return invert(self.right_from_left)[:3, 3]

    @cached_property
    def ideal(self) -> StereoRig:
        """Rig with the same parameters and perfect lenses."""
        perfect = all(camera.distortion.is_zero for camera in self.cameras)
        return self if perfect else replace(self, left=self.left.ideal, right=self.right.ideal)

    @cached_property
    def kernel_cameras(self) -> Cameras:
        """Both cameras in the form that kernels take, for points in the camera frame C."""
        # Imported late, because importing numba takes time.
        from cmmsim.geometry.camera_kernels import Cameras

        return Cameras(
            np.array([camera.intrinsics for camera in self.cameras]),
            np.array([(camera.width, camera.height) for camera in self.cameras], dtype=float),
            np.stack(self.from_camera),
        )

    @property
    def projection_matrices(self) -> tuple[Array, Array]:
        """Projection matrices (3,4) from the camera frame C to ideal left and right pixels."""
        return self.left.matrix @ np.eye(4)[:3], self.right.matrix @ self.right_from_left[:3]

    @property
    def fundamental(self) -> Array:
        """Fundamental matrix F (3, 3) with right' F left = 0.

        ``left`` and ``right`` are homogeneous ideal pixels of the same point.
        """
        rotation = self.right_from_left[:3, :3]
        shift = self.right_from_left[:3, 3]
        # the essential matrix is [t]x R
        essential = np.cross(np.eye(3), shift) @ rotation
        return np.linalg.inv(self.right.matrix).T @ essential @ np.linalg.inv(self.left.matrix)

    def project(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Return pixels (2, n, 2) of points (n, 3) in both images, and whether each is seen (2, n).

        The points are in the camera frame C.
        """
        seen = [
            camera.project(apply(move, points))
            for camera, move in zip(self.cameras, self.from_camera, strict=True)
        ]
        return np.stack([s[0] for s in seen]), np.stack([s[1] for s in seen])

    def derivatives(self, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of the pixels of points (n, 3) in both images.

        The first result (2, n, 2, 3) is with respect to the points, in the camera frame C, and the
        second (2, n, 2, 24) with respect to the rig's parameters in the order of PARAMETER_NAMES.
        """
        by_points = np.empty((2, len(points), 2, 3))
        by_rig = np.zeros((2, len(points), 2, len(PARAMETER_NAMES)))
        for side, (camera, move) in enumerate(zip(self.cameras, self.from_camera, strict=True)):
            arguments = (
                rotation_log(move[:3, :3]),
                move[:3, 3],
                camera.matrix,
                camera.intrinsics[4:],
            )
            jacobian = cv2.projectPoints(np.ascontiguousarray(points), *arguments)[1].reshape(
                len(points), 2, -1
            )
            by_turn = jacobian[..., :3]
            by_shift = jacobian[..., 3:6]
            intrinsics = jacobian[..., 6:]
            by_points[side] = by_shift @ move[:3, :3]
            by_rig[side, ..., 9 * side : 9 * side + 9] = intrinsics
            if side == 1:
                by_rig[side, ..., 18:] = np.concatenate([by_shift, by_turn], axis=-1)
        return by_points, by_rig

    @property
    def parameters(self) -> Array:
        """Parameters (24,) in the order of PARAMETER_NAMES."""
        transform = self.right_from_left
        return np.concatenate(
            [
                self.left.intrinsics,
                self.right.intrinsics,
                transform[:3, 3],
                rotation_log(transform[:3, :3]),
            ]
        )

    def moved(self, changes: Array) -> StereoRig:
        """Return the rig after adding ``changes`` (24,) to its parameters.

        The camera frame C remains that of the left camera.
        """
        if not changes.any():
            return self
        values = self.parameters + changes
        left, right = (
            camera_from(each, camera.width, camera.height)
            for each, camera in zip(values[:18].reshape(2, 9), self.cameras, strict=True)
        )
        return StereoRig(left, right, rigid(rotation_exp(values[21:]), values[18:21]))


def toed_in_rig(
    camera: PinholeCamera, baseline: float, position: Array, target: Array
) -> tuple[StereoRig, Array]:
    """Return a rig of two equal cameras aimed at one point, and ``camera_from_base`` (4, 4).

    ``position`` (3,) is the middle of the baseline, and both optical axes pass through ``target``
    (3,), m in the base frame. The baseline is horizontal, which means normal to the base frame's z
    axis, and perpendicular to the viewing direction, which must not be vertical.
    """
    forward = target - position
    right_axis = np.cross(forward, [0.0, 0.0, 1.0])
    right_axis /= np.linalg.norm(right_axis)
    left, right = (
        _look_at(position + side * 0.5 * baseline * right_axis, target) for side in (-1.0, 1.0)
    )
    return StereoRig(camera, camera, right @ invert(left)), left


def placed_rig(rig: StereoRig, position: Array, target: Array) -> Array:
    """Return camera_from_base (4, 4) of a rig with the middle of its baseline at ``position`` (3,).

    The rig looks at ``target`` (3,), m in the base frame. The viewing direction is the mean of both
    optical axes, projected perpendicular to the baseline. For a rig that ``toed_in_rig`` made for
    the same position and target, both functions return the same transform.
    """
    x = rig.right_centre / np.linalg.norm(rig.right_centre)
    # the sum of both optical axes, in the axes of the left camera, has the viewing direction
    y = np.cross(np.array([0.0, 0.0, 1.0]) + rig.right_from_left[2, :3], x)
    y /= np.linalg.norm(y)
    return rigid(np.column_stack([x, y, np.cross(x, y)]), 0.5 * rig.right_centre) @ _look_at(
        position, target
    )


def _look_at(eye: Array, target: Array) -> Array:
    """Return camera_from_base (4, 4) of a camera at ``eye`` (3,) aimed at ``target`` (3,).

    Its x axis is horizontal.
    """
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return invert(rigid(np.column_stack([x, np.cross(z, x), z]), eye))


def radius_at(rig: StereoRig, camera_from_base: Array, target: Array, radius: float) -> float:
    """Return the image radius in px of a sticker of ``radius`` m at ``target`` (3,) m in base axes.

    It is the larger one of the radii in both images, each for a sticker that faces the camera.
    """
    distances = [
        float(np.linalg.norm(apply(move @ camera_from_base, target))) for move in rig.from_camera
    ]
    return max(
        radius * float(camera.focal_lengths.max()) / distance
        for camera, distance in zip(rig.cameras, distances, strict=True)
    )
