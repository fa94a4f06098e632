"""Points from pixel pairs: OpenCV's linear triangulation, then weighted Gauss-Newton steps, and covariances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig

STEPS = 2  # of Gauss-Newton after the linear start


@dataclass(frozen=True)
class StereoPoints:
    """points (n,3) and covariances (n,3,3) in the camera frame, m; ray_gap (n,): the squared distance of the two rays
    in units of the pixel noise (one degree of freedom)."""

    points: Array
    covariances: Array
    ray_gap: Array


def triangulate(
    rig: StereoRig, left: Array, right: Array, left_covariances: Array, right_covariances: Array
) -> StereoPoints:
    """Points seen at ideal pixels ``left`` and ``right`` (n, 2) with covariances (n, 2, 2), px²."""
    if left.shape != right.shape or left.ndim != 2 or left.shape[1] != 2:
        raise ShapeError(f"left and right pixels must both be (n,2), got {left.shape} and {right.shape}")
    from cmmsim.geometry.point_kernel import refine_points  # compiles, so it is loaded where it is first needed

    points = np.ascontiguousarray(linear_triangulation(rig, left, right))
    weights = np.linalg.inv(np.stack([left_covariances, right_covariances], axis=1))
    covariances, gaps = np.empty((len(points), 3, 3)), np.empty(len(points))
    refine_points(
        np.stack(rig.projection_matrices), np.stack([left, right], axis=1), weights, STEPS, points, covariances, gaps
    )
    return StereoPoints(points, covariances, gaps)


def linear_triangulation(rig: StereoRig, left: Array, right: Array) -> Array:
    """Points (n, 3) in the camera frame by OpenCV's linear method (float64)."""
    if len(left) == 0:
        return np.zeros((0, 3))
    first, second = rig.projection_matrices
    homogeneous = cv2.triangulatePoints(
        first, second, np.ascontiguousarray(left.T, dtype=np.float64), np.ascontiguousarray(right.T, dtype=np.float64)
    )
    return (homogeneous[:3] / homogeneous[3]).T
