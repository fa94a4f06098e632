"""Two cameras held by one rigid bar, and points triangulated from both of their images.

The camera frame C of the sensor is the frame of the left camera. Points come from OpenCV's linear
triangulation, followed by weighted Gauss-Newton steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cmmsim.errors import ShapeError
from cmmsim.geometry.camera import INTRINSIC_NAMES, NDArrayBool, PinholeCamera, camera_from
from cmmsim.geometry.pose import Array, apply, invert, rigid, rotation_exp, rotation_log

if TYPE_CHECKING:
    from cmmsim.geometry.camera_kernels import Cameras

PLACE_NAMES = ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")
PARAMETER_NAMES = (
    *(f"{side}.{name}" for side in ("left", "right") for name in INTRINSIC_NAMES),
    *(f"right_from_left.{name}" for name in PLACE_NAMES),
)
"""Names of a rig's parameters: the intrinsics of both cameras, and translation and rotation vector
of ``right_from_left``.
"""

# m: length of the last step of a triangulation.
SETTLED = 1e-8


@dataclass(frozen=True)
class StereoRig:
    """Two cameras on one rigid bar.

    Parameters
    ----------
    left, right : PinholeCamera
        The cameras.
    right_from_left : ndarray, shape (4, 4)
        Transform from the left camera's axes into the right one's.

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
        """Transforms (4, 4) from the camera frame C into the axes of the left and of the right
        camera.
        """
        return np.eye(4), self.right_from_left

    @cached_property
    def ideal(self) -> StereoRig:
        """The same rig with perfect lenses."""
        perfect = all(camera.distortion.is_zero for camera in self.cameras)
        return self if perfect else replace(self, left=self.left.ideal, right=self.right.ideal)

    @cached_property
    def figures(self) -> Cameras:
        """Both cameras as compiled functions take them, for points in the camera frame C."""
        # Late, as numba takes time to import.
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
        """Fundamental matrix F (3, 3) of ideal pixels: right' F left = 0 for homogeneous pixels of
        one point.
        """
        rotation = self.right_from_left[:3, :3]
        shift = self.right_from_left[:3, 3]
        # The essential matrix is [t]x R.
        essential = np.cross(np.eye(3), shift) @ rotation
        return np.linalg.inv(self.right.matrix).T @ essential @ np.linalg.inv(self.left.matrix)

    def project(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Return pixels (2, n, 2) of points (n, 3) in C in both images, and whether they are seen
        (2, n).
        """
        seen = [
            camera.project(apply(move, points))
            for camera, move in zip(self.cameras, self.from_camera, strict=True)
        ]
        return np.stack([s[0] for s in seen]), np.stack([s[1] for s in seen])

    def derivatives(self, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of both pixels of points (n, 3) in C.

        They are by the points (2, n, 2, 3), and by the rig's parameters (2, n, 2, 24) in the order
        of PARAMETER_NAMES.
        """
        by_points = np.empty((2, len(points), 2, 3))
        by_rig = np.zeros((2, len(points), 2, len(PARAMETER_NAMES)))
        for side, (camera, move) in enumerate(zip(self.cameras, self.from_camera, strict=True)):
            known = rotation_log(move[:3, :3]), move[:3, 3], camera.matrix, camera.intrinsics[4:]
            found = cv2.projectPoints(np.ascontiguousarray(points), *known)[1].reshape(
                len(points), 2, -1
            )
            by_turn = found[..., :3]
            by_shift = found[..., 3:6]
            intrinsics = found[..., 6:]
            by_points[side] = by_shift @ move[:3, :3]
            by_rig[side, ..., 9 * side : 9 * side + 9] = intrinsics
            if side == 1:
                by_rig[side, ..., 18:] = np.concatenate([by_shift, by_turn], axis=-1)
        return by_points, by_rig

    @property
    def parameters(self) -> Array:
        """Parameters (24,) in the order of PARAMETER_NAMES."""
        place = self.right_from_left
        return np.concatenate(
            [self.left.intrinsics, self.right.intrinsics, place[:3, 3], rotation_log(place[:3, :3])]
        )

    def moved(self, changes: Array) -> StereoRig:
        """Return the rig with changes (24,) of its parameters.

        Its camera frame C stays that of the left camera.
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
    """Return a rig whose cameras look at one point, and the true ``camera_from_base`` (4, 4).

    ``position`` (3,) is the middle of the baseline and ``target`` (3,) the point looked at, m in
    the base frame. The baseline is horizontal and perpendicular to the viewing direction.
    """
    forward = target - position
    right_axis = np.cross(forward, [0.0, 0.0, 1.0])
    right_axis /= np.linalg.norm(right_axis)
    eyes = [_look_at(position + side * 0.5 * baseline * right_axis, target) for side in (-1.0, 1.0)]
    return StereoRig(camera, camera, eyes[1] @ invert(eyes[0])), eyes[0]


def placed_rig(rig: StereoRig, position: Array, target: Array) -> Array:
    """Return camera_from_base (4, 4) of a rig with the middle of its baseline at ``position`` (3,).

    The rig looks at ``target``. The direction of view is the mean of both optical axes, made
    perpendicular to the baseline. A toed-in rig is put where ``toed_in_rig`` puts it, as long as
    its baseline is horizontal there.
    """
    right_centre = invert(rig.right_from_left)[:3, 3]
    x = right_centre / np.linalg.norm(right_centre)
    # The sum of both optical axes, in the axes of the left camera, is the direction of view.
    y = np.cross(np.array([0.0, 0.0, 1.0]) + rig.right_from_left[2, :3], x)
    y /= np.linalg.norm(y)
    return rigid(np.column_stack([x, y, np.cross(x, y)]), 0.5 * right_centre) @ _look_at(
        position, target
    )


def _look_at(eye: Array, target: Array) -> Array:
    """Return camera_from_base (4, 4) of a camera at ``eye`` (3,) that looks at ``target`` (3,).

    Its x axis is horizontal.
    """
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return invert(rigid(np.column_stack([x, np.cross(z, x), z]), eye))


@dataclass(frozen=True)
class StereoPoints:
    """Points (n, 3) with covariances (n, 3, 3) in the camera frame, m.

    ``ray_gap`` (n,) is the squared distance of the two rays in units of the pixel noise, with one
    degree of freedom.
    """

    points: Array
    covariances: Array
    ray_gap: Array


def triangulate(
    rig: StereoRig,
    left: Array,
    right: Array,
    left_covariances: Array,
    right_covariances: Array,
    near: Array | None = None,
    parted: float = 0.0,
) -> StereoPoints:
    """Return the points seen at pixels ``left`` and ``right`` (n, 2) with covariances (n, 2, 2),
    px².

    The search starts at ``near`` points (n, 3), or where the linear method finds them. ``parted``
    px² is added to the covariances while the rays are laid onto each other, but not to the
    result's.
    """
    if left.shape != right.shape or left.ndim != 2 or left.shape[1] != 2:
        raise ShapeError(
            f"left and right pixels must both be (n,2), got {left.shape} and {right.shape}"
        )
    # Late, as numba takes time to import.
    from cmmsim.geometry.camera_kernels import triangulate_all

    if near is None:
        near = linear_triangulation(rig, rig.left.undistort(left)[0], rig.right.undistort(right)[0])
    points = np.array(near, dtype=float)
    covariances = np.empty((len(points), 3, 3))
    gaps = np.empty(len(points))
    pixels = np.stack([left, right], axis=1)
    spreads = np.stack([left_covariances, right_covariances], axis=1)
    triangulate_all(rig.figures, pixels, spreads, parted, SETTLED, points, covariances, gaps)
    return StereoPoints(points, covariances, gaps)


def linear_triangulation(rig: StereoRig, left: Array, right: Array) -> Array:
    """Return points (n, 3) in the camera frame by OpenCV's linear method (float64)."""
    if len(left) == 0:
        return np.zeros((0, 3))
    first, second = rig.projection_matrices
    homogeneous = cv2.triangulatePoints(
        first,
        second,
        np.ascontiguousarray(left.T, dtype=np.float64),
        np.ascontiguousarray(right.T, dtype=np.float64),
    )
    return (homogeneous[:3] / homogeneous[3]).T
