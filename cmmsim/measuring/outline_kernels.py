"""Compiled test of a sticker's ellipse against the ellipse of an unhidden sticker."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, project
from cmmsim.geometry.disc_kernels import disc_ellipse, distorted_root
from cmmsim.geometry.matrix_kernels import square_by
from cmmsim.geometry.transform_kernels import transform_point


class Outlines(NamedTuple):
    """Ellipses of stickers in both images. All arrays are empty if no ellipses are known.

    ``shapes`` (n, 2, 3) are the entries xx, xy, yy of the ellipses' matrices, px. ``informations``
    (n, 2, 6) are the entries 00, 01, 02, 11, 12, 22 of their inverse covariances, px^-2.
    ``normals`` (n, 3) are the stickers' normals in body axes, and ``radius`` is the stickers'
    radius, m. ``cameras`` are as the estimator knows them.
    """

    shapes: Array
    informations: Array
    normals: Array
    radius: float
    cameras: Cameras


@compiled
def outline_misfit(outlines: Outlines, n: int, side: int, transform: Array, taught: Array) -> float:
    """Return the squared misfit of the ellipse of sticker ``n`` in image ``side``.

    The misfit is the difference from the ellipse of an unhidden sticker, in units of its noise. The
    sticker is taught at ``taught`` (3,) on a body at ``transform`` (4, 4), camera_from_body.
    """
    camera = outlines.cameras.intrinsics[side]
    move = outlines.cameras.extrinsics[side]
    point = np.empty(3)
    centre = np.empty(3)
    turned = np.empty(3)
    normal = np.empty(3)
    transform_point(transform, taught, 1.0, point)
    transform_point(move, point, 1.0, centre)
    transform_point(transform, outlines.normals[n], 0.0, turned)
    transform_point(move, turned, 0.0, normal)
    x, y, xx, xy, yy = disc_ellipse(centre, normal, outlines.radius, camera)
    _, _, a, b, c, d = project(camera, x, y, 1.0)
    xx, xy, yy = distorted_root(xx, xy, yy, a, b, c, d)
    shape = outlines.shapes[n, side]
    return square_by(outlines.informations[n, side], shape[0] - xx, shape[1] - xy, shape[2] - yy)
