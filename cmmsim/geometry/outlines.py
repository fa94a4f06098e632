"""The ellipses in which both cameras see the stickers of a body, in the images as they are."""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.projected_disc import project_discs
from cmmsim.geometry.stereo_rig import StereoRig


def sticker_outlines(
    rig: StereoRig, camera_from_body: Array, places: Array, normals: Array, radius: float
) -> tuple[Array, Array]:
    """Centres (2, n, 2) px and shapes A (2, n, 2, 2) px of the ellipses of n stickers before both cameras.

    Parameters: camera_from_body (4,4); places (n,3) m and normals (n,3) in body axes; radius m. Distortion is taken as
    linear across a sticker.
    """
    centres, shapes = [], []
    for camera, from_camera in zip(rig.cameras, rig.from_camera, strict=True):
        move = from_camera @ camera_from_body
        middles, shape = project_discs(
            camera.ideal, apply(move, places), normals @ move[:3, :3].T, np.full(len(places), radius)
        )
        if not camera.distortion.is_zero:
            local = camera.distortion_jacobian(middles) @ shape
            middles, shape = camera.distort(middles)[0], symmetric_root(local @ local.swapaxes(-1, -2))
        centres.append(middles)
        shapes.append(shape)
    return np.stack(centres), np.stack(shapes)


def symmetric_root(matrices: Array) -> Array:
    """Symmetric positive definite roots (..., 2, 2) of such matrices: (M + d I) / sqrt(trace M + 2 d), d² = det M."""
    d = np.sqrt(np.linalg.det(matrices))[..., None, None]
    trace = np.trace(matrices, axis1=-2, axis2=-1)[..., None, None]
    return (matrices + d * np.eye(2)) / np.sqrt(trace + 2.0 * d)
