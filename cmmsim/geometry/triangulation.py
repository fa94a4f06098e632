"""Triangulation: points in space, with covariances, from their pixels in both images of a rig.

Weighted Gauss-Newton steps, which are in ``triangulation_kernels``, follow OpenCV's linear method.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig

# m: a triangulation ends with a shorter step, or after TRIANGULATION_STEPS.
STEP_TOLERANCE = 1e-8


@dataclass(frozen=True)
class StereoPoints:
    """Points (n, 3) with covariances (n, 3, 3) in the camera frame, m.

    ``ray_gap`` (n,) is the squared distance of the two rays in units of its variance, a chi-square
    with one degree of freedom. ``rays`` (n,) are its square roots, with the sign that
    ``triangulation_kernels.signed_distance`` defines.
    """

    points: Array
    covariances: Array
    ray_gap: Array
    rays: Array


def triangulate(
    rig: StereoRig,
    left: Array,
    right: Array,
    left_covariances: Array,
    right_covariances: Array,
    near: Array | None = None,
    line_variance: float = 0.0,
) -> StereoPoints:
    """Return the points at pixels ``left`` and ``right`` (n, 2) with covariances (n, 2, 2) px².

    The start values are ``near`` (n, 3), or the results of the linear method if it is None.
    ``line_variance`` px², for errors of the rig, is added to the covariances for the weights and
    the ray gap. The stated covariances of the points are those of the pixel noise alone, see
    ``triangulate_point``. Raises ShapeError unless both arrays of pixels are (n, 2).
    """
    if left.shape != right.shape or left.ndim != 2 or left.shape[1] != 2:
        raise ShapeError(
            f"left and right pixels must both be (n,2), got {left.shape} and {right.shape}"
        )
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.triangulation_kernels import triangulate_all

    if near is None:
        near = linear_triangulation(rig, rig.left.undistort(left)[0], rig.right.undistort(right)[0])
    # in C order, because the kernel would be compiled once more for another memory layout
    points = np.array(near, dtype=float, order="C")
    covariances = np.empty((len(points), 3, 3))
    gaps = np.empty(len(points))
    rays = np.empty(len(points))
    pixels = np.ascontiguousarray(np.stack([left, right], axis=1))
    pixel_covariances = np.ascontiguousarray(
        np.stack([left_covariances, right_covariances], axis=1)
    )
    triangulate_all(
        rig.kernel_cameras,
        pixels,
        pixel_covariances,
        line_variance,
        STEP_TOLERANCE,
        points,
        covariances,
        gaps,
        rays,
    )
    return StereoPoints(points, covariances, gaps, rays)


def linear_triangulation(rig: StereoRig, left: Array, right: Array) -> Array:
    """Return points (n, 3), in the camera frame, of ideal pixels (n, 2), by OpenCV's method."""
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
