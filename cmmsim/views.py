"""What is to be drawn: windows of a camera's image, and the patches that reach into each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import PinholeCamera
from .pose import Array
from .scene import Patch

NEAR, FAR = 0.2, 10.0  # m


@dataclass(frozen=True)
class View:
    """One window: a camera, camera_from_body transforms (b,4,4), the window's first pixel (x, y) and size (w, h) px."""

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
        matrix[1, 1], matrix[1, 2] = 2.0 * camera.focal_px / height, 2.0 * y / height - 1.0
        matrix[2, 2], matrix[2, 3] = (FAR + NEAR) / (FAR - NEAR), -2.0 * FAR * NEAR / (FAR - NEAR)
        matrix[3, 2] = 1.0
        return matrix


class Drawable:
    """Patches of several bodies: which body each belongs to, and its bounding sphere."""

    def __init__(self, patches: Sequence[Patch], body_index: Sequence[int]) -> None:
        self.patches = tuple(patches)
        self.body_index = np.array(body_index, dtype=int)
        self.centres = np.array([0.5 * (p.vertices.min(axis=0) + p.vertices.max(axis=0)) for p in patches])
        self.radii = np.array([np.linalg.norm(p.vertices - c, axis=1).max()
                               for p, c in zip(patches, self.centres, strict=True)])

    def reaching(self, views: Sequence[View]) -> NDArray[np.bool_]:
        """Whether the bounding sphere of each patch reaches into each window (n views, n patches)."""
        moves = np.stack([v.camera_from_bodies for v in views])[:, self.body_index]
        centres = np.einsum("vpij,pj->vpi", moves[..., :3, :3], self.centres) + moves[..., :3, 3]
        depth = centres[..., 2]
        nearest = depth - self.radii
        focal = np.array([v.camera.focal_px for v in views])[:, None]
        middle = np.array([[v.camera.centre_x_px, v.camera.centre_y_px] for v in views])
        corners, sizes = (np.array([getattr(v, name) for v in views], dtype=float) for name in ("corner", "size"))
        pixels = focal[..., None] * centres[..., :2] / np.maximum(depth, NEAR)[..., None] + (middle - corners)[:, None]
        # off the axis a sphere's image is larger than focal * radius / depth; 1.5 covers angles to 48 degrees
        reach = (1.5 * focal * self.radii / np.maximum(nearest, NEAR) + 1.0)[..., None]
        inside = np.all((pixels > -reach) & (pixels < sizes[:, None] + reach), axis=-1)
        return ((nearest <= NEAR) & (depth > -self.radii)) | (inside & (depth > 0.0))
