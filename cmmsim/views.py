"""What is to be drawn: windows of a camera's image, and the patches that reach into each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .camera import PinholeCamera
from .pose import Array
from .scene import Patch

NEAR, FAR = 0.2, 10.0  # m


@dataclass(frozen=True)
class View:
    """One window of a camera with a perfect lens: camera_from_body transforms (b,4,4), its first pixel (x, y) and its
    size (w, h) px."""

    camera: PinholeCamera
    camera_from_bodies: Array
    corner: tuple[float, float]
    size: tuple[int, int]

    def projection(self) -> Array:
        """Clip-from-camera matrix (4,4) for OpenCV camera axes; row 0 of the drawing is the window's top row.

        The half pixel turns OpenCV's pixel-centre convention into OpenGL's pixel-corner convention.
        """
        camera, (width, height) = self.camera, self.size
        x, y = camera.centre_x_px + 0.5 - self.corner[0], camera.centre_y_px + 0.5 - self.corner[1]
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[0, 2] = 2.0 * camera.focal_px / width, 2.0 * x / width - 1.0
        matrix[1, 1], matrix[1, 2] = 2.0 * camera.focal_px * camera.aspect / height, 2.0 * y / height - 1.0
        matrix[2, 2], matrix[2, 3] = (FAR + NEAR) / (FAR - NEAR), -2.0 * FAR * NEAR / (FAR - NEAR)
        matrix[3, 2] = 1.0
        return matrix


def same_exposure(views: Sequence[View]) -> list[list[int]]:
    """Indices of the views, grouped by camera and exposure."""
    groups: dict[tuple[int, int], list[int]] = {}
    for k, view in enumerate(views):
        groups.setdefault((id(view.camera), id(view.camera_from_bodies)), []).append(k)
    return list(groups.values())


class Drawable:
    """Patches of several bodies: which body each belongs to, the corners (n,8,3) of its bounding box, m, and the
    distance m from which they are usually looked at, for which discs are triangulated."""

    def __init__(self, patches: Sequence[Patch], body_index: Sequence[int], distance: float) -> None:
        self.patches = tuple(patches)
        self.body_index = np.array(body_index, dtype=int)
        self.corners = np.array([list(product(*p.bounds.T)) for p in patches])
        self.distance = distance

    def reaching(self, views: Sequence[View]) -> NDArray[np.bool_]:
        """Which patches may show in each window (n views, n patches): bounding boxes against windows."""
        result = np.empty((len(views), len(self.patches)), dtype=bool)
        for group in same_exposure(views):
            lowest, highest = self._extents(views[group[0]])
            first = np.array([views[k].corner for k in group])[:, None] - 0.5
            last = first + [[views[k].size] for k in group]
            result[group] = ((highest >= first) & (lowest <= last)).all(axis=2)
        return result

    def _extents(self, view: View) -> tuple[Array, Array]:
        """Smallest and largest pixel (n,2) of each patch's bounding box; a box not wholly ahead may show anywhere."""
        moves = view.camera_from_bodies[self.body_index]
        corners = np.einsum("pij,pcj->pci", moves[:, :3, :3], self.corners) + moves[:, None, :3, 3]
        depth = corners[..., 2]
        pixels = view.camera.project(np.where(depth[..., None] > NEAR, corners, [0.0, 0.0, 1.0]))[0]
        lowest, highest = pixels.min(axis=1), pixels.max(axis=1)
        crossing = depth.min(axis=1) <= NEAR
        lowest[crossing], highest[crossing] = -np.inf, np.inf
        behind = depth.max(axis=1) <= 0.0
        lowest[behind], highest[behind] = np.inf, -np.inf
        return lowest, highest
