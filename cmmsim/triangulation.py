"""Points from pixel pairs: OpenCV's linear triangulation, then one weighted Gauss-Newton step, and covariances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .errors import ShapeError
from .pose import Array, apply
from .stereo_rig import StereoRig


@dataclass(frozen=True)
class StereoPoints:
    """points (n,3) and covariances (n,3,3) in the camera frame, m; ray_gap (n,): the squared distance of the two rays
    in units of the pixel noise (one degree of freedom)."""

    points: Array
    covariances: Array
    ray_gap: Array


def triangulate(rig: StereoRig, left: Array, right: Array, left_covariances: Array,
                right_covariances: Array) -> StereoPoints:
    """Points seen at pixels ``left`` and ``right`` (n, 2) with covariances (n, 2, 2), px²."""
    if left.shape != right.shape or left.ndim != 2 or left.shape[1] != 2:
        raise ShapeError(f"left and right pixels must both be (n,2), got {left.shape} and {right.shape}")
    points = linear_triangulation(rig, left, right)
    observed = np.stack([left, right], axis=1)
    weights = np.linalg.inv(np.stack([left_covariances, right_covariances], axis=1))
    for _ in range(2):
        residuals, jacobian = _reprojection(rig, points, observed)
        weighted = np.einsum("nkai,nkab->nkib", jacobian, weights)
        covariances = np.linalg.inv(np.einsum("nkib,nkbj->nij", weighted, jacobian))
        points = points + np.einsum("nij,nkjb,nkb->ni", covariances, weighted, residuals)
    residuals, _ = _reprojection(rig, points, observed)
    gap = np.einsum("nka,nkab,nkb->n", residuals, weights, residuals)
    return StereoPoints(points, covariances, gap)


def linear_triangulation(rig: StereoRig, left: Array, right: Array) -> Array:
    """Points (n, 3) in the camera frame by OpenCV's linear method (float64)."""
    if len(left) == 0:
        return np.zeros((0, 3))
    first, second = rig.projection_matrices
    homogeneous = cv2.triangulatePoints(first, second, np.ascontiguousarray(left.T, dtype=np.float64),
                                        np.ascontiguousarray(right.T, dtype=np.float64))
    return (homogeneous[:3] / homogeneous[3]).T


def _reprojection(rig: StereoRig, points: Array, observed: Array) -> tuple[Array, Array]:
    """Residual pixels (n, 2 cameras, 2) and their Jacobian (n, 2, 2, 3) by the points."""
    residuals = np.empty_like(observed)
    jacobian = np.empty((len(points), 2, 2, 3))
    for k, (camera, move) in enumerate(zip(rig.cameras, rig.from_camera, strict=True)):
        local = apply(move, points)
        residuals[:, k] = observed[:, k] - camera.project(local)[0]
        jacobian[:, k] = camera.projection_jacobian(local) @ move[:3, :3]
    return residuals, jacobian
