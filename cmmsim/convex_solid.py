"""Convex solids as the analytic renderer needs them: what they hide, and their outline in an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from .camera import PinholeCamera
from .pose import Array, apply, invert

TOUCHING = 1e-6  # share of the way to a point in which meeting a solid is taken for lying on it


class ConvexSolid:
    """The convex hull of vertices (n,3), m."""

    def __init__(self, vertices: Array) -> None:
        hull = ConvexHull(vertices)
        self.vertices = vertices[hull.vertices]
        faces = np.unique(np.round(hull.equations, 12), axis=0)
        self._normals, self._offsets = faces[:, :3], faces[:, 3]

    def hides(self, camera_from_body: Array, points: Array) -> NDArray[np.bool_]:
        """Whether the solid stands between the camera and points (..., 3) in camera axes."""
        body_from_camera = invert(camera_from_body)
        eye = body_from_camera[:3, 3]
        closing = (apply(body_from_camera, points) - eye) @ self._normals.T
        distance = -(self._normals @ eye + self._offsets)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = distance / closing
        enter = np.where(closing < 0.0, share, -np.inf).max(axis=-1)
        leave = np.where(closing > 0.0, share, np.inf).min(axis=-1)
        outside = np.any((closing == 0.0) & (distance < 0.0), axis=-1)
        return ~outside & (enter < leave) & (leave > 0.0) & (enter < 1.0 - TOUCHING)

    def outline(self, camera: PinholeCamera, camera_from_body: Array) -> Outline | None:
        """The solid's outline in the image; None unless all of it lies before the camera."""
        points = apply(camera_from_body, self.vertices)
        if points[:, 2].min() <= 1e-3:
            return None
        pixels = camera.project(points)[0]
        return Outline(np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=float))


class Outline:
    """A convex polygon (n,2) px of either sense of rotation."""

    def __init__(self, corners: Array) -> None:
        self.lowest, self.highest = corners.min(axis=0), corners.max(axis=0)
        side = np.roll(corners, -1, axis=0) - corners
        outwards = np.column_stack([side[:, 1], -side[:, 0]])
        outwards *= np.sign(np.sum(outwards * (corners - corners.mean(axis=0)), axis=1))[:, None]
        keep = np.abs(outwards).sum(axis=1) > 1e-6
        self._a, self._b = outwards[keep].T
        self._c = np.sum(outwards * corners, axis=1)[keep]  # inside: a x + b y <= c

    def holds(self, corner: Array, size: tuple[int, int]) -> bool:
        """Whether a window with first pixel ``corner`` (2,) and ``size`` (w, h) lies wholly inside."""
        x = corner[0] - 0.5 + np.array([0.0, size[0], 0.0, size[0]])
        y = corner[1] - 0.5 + np.array([0.0, 0.0, size[1], size[1]])
        return bool(np.all(np.outer(self._a, x) + np.outer(self._b, y) <= self._c[:, None]))

    def cover(self, corner: Array, size: tuple[int, int], lines: int) -> NDArray[np.float32]:
        """Share (h, w) of each pixel of a window inside: exact along x, the mean of ``lines`` scan lines along y."""
        y = corner[1] - 0.5 + (np.arange(size[1] * lines) + 0.5) / lines
        room = self._c[:, None] - self._b[:, None] * y
        with np.errstate(divide="ignore", invalid="ignore"):
            at = room / self._a[:, None]
        right = np.where(self._a[:, None] > 0.0, at, np.inf).min(axis=0)
        left = np.where(self._a[:, None] < 0.0, at, -np.inf).max(axis=0)
        right[np.any((self._a[:, None] == 0.0) & (room < 0.0), axis=0)] = -np.inf
        ticks = (corner[0] - 0.5 + np.arange(size[0])).astype(np.float32)
        share = np.minimum(right[:, None].astype(np.float32), ticks + 1) - np.maximum(left[:, None].astype(np.float32),
                                                                                     ticks)
        return np.clip(share, 0.0, 1.0).reshape(size[1], lines, size[0]).mean(axis=1)
