"""The ellipse in which a camera sees a disc, exact in perspective.

With C the centre, n the unit normal and R the radius in camera axes, C C' - R² (I - n n') is the dual conic of the
rim; carried to pixels by the camera matrix it gives the ellipse's centre and, in its upper left, its shape.
"""

from __future__ import annotations

import numpy as np

from .camera import PinholeCamera
from .pose import Array


def project_discs(camera: PinholeCamera, centres: Array, normals: Array, radii: Array) -> tuple[Array, Array]:
    """Ellipses of n discs wholly before the camera: ideal centres (n,2) px and shapes A (n,2,2) px, symmetric.

    Parameters: centres (n,3) m and normals (n,3) unit, in camera axes; radii (n,) m. The ellipse is the image of the
    unit disc under x -> centre + A x.
    """
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    dual = centres[:, :, None] * centres[:, None, :] - radii[:, None, None] ** 2 * across
    dual = dual / dual[:, 2:, 2:]
    middle = dual[:, :2, 2]
    focal = camera.focal_lengths
    squared = focal[:, None] * focal * (middle[:, :, None] * middle[:, None, :] - dual[:, :2, :2])
    pixels = focal * middle + (camera.centre_x_px, camera.centre_y_px)
    return pixels, _root(squared)


def _root(matrices: Array) -> Array:
    """Symmetric square roots of positive definite (n,2,2): (M + d I) / sqrt(trace M + 2 d), d² = det M."""
    d = np.sqrt(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2)
    scale = np.sqrt(matrices[:, 0, 0] + matrices[:, 1, 1] + 2.0 * d)
    return (matrices + d[:, None, None] * np.eye(2)) / scale[:, None, None]
