"""Convex solids as the analytic renderer needs them: what they hide, and their outline in an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply, invert

TOUCHING = 1e-6  # share of the way to a point in which meeting a solid is taken for lying on it


class ConvexSolid:
    """The convex hull of vertices (n,3), m."""

    def __init__(self, vertices: Array) -> None:
        hull = ConvexHull(vertices)
        self.vertices = vertices[hull.vertices]
        self.middle = self.vertices.mean(axis=0)
        faces = np.unique(np.round(hull.equations, 12), axis=0)
        self._normals, self._offsets = np.ascontiguousarray(faces[:, :3]), np.ascontiguousarray(faces[:, 3])

    def hides(self, camera_from_body: Array, points: Array) -> NDArray[np.bool_]:
        """Whether the solid stands between the camera and points (..., 3) in camera axes."""
        from cmmsim.imaging.layer_kernel import hidden_points  # compiles, so it is loaded where it is first needed

        flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
        hidden = np.empty(len(flat), dtype=bool)
        hidden_points(invert(camera_from_body), flat, self._normals, self._offsets, TOUCHING, hidden)
        return hidden.reshape(points.shape[:-1])

    def outline(self, camera: PinholeCamera, camera_from_body: Array) -> Outline | None:
        """The solid's outline in the image; None unless all of it lies before the camera."""
        points = apply(camera_from_body, self.vertices)
        if points[:, 2].min() <= 1e-3:
            return None
        pixels = camera.project(points)[0]
        return Outline(np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=float))


class Outline:
    """A convex polygon (n,2) px of either sense of rotation: ``half_planes`` (m,3) are a, b, c of a x + b y <= c, and
    ``box`` (4,) its lowest x, y and highest x, y."""

    def __init__(self, corners: Array) -> None:
        from cmmsim.imaging.layer_kernel import half_planes_of  # compiles, so it is loaded where it is first needed

        self.box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        half_planes = np.empty((len(corners), 3))
        self.half_planes = half_planes[: half_planes_of(corners, half_planes)]
