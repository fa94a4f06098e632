"""Compiled kernels that find the stickers that convex solids hide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.disc_kernels import probe_discs
from cmmsim.geometry.transform_kernels import transform_point
from cmmsim.imaging.layer_kernels import occludes

# Number of points around a sticker that are tested in addition to its middle.
PROBES = 12
# A solid that a line of sight enters within the final fraction TOUCHING of the line's length does
# not hide the point, because the point lies on the solid's surface.
TOUCHING = 1e-6


class Solids(NamedTuple):
    """Convex solids in their own axes.

    The faces of solid b are the slice ``starts[b]:starts[b + 1]`` of the outward normals (f, 3) and
    offsets (f,): normal . x + offset <= 0 inside. The ball with ``radii[b]`` around ``middles[b]``
    (3,) contains the solid.
    """

    starts: Array
    normals: Array
    offsets: Array
    middles: Array
    radii: Array


@compiled
def reaches(eye: Array, point: Array, middle: Array, radius: float) -> bool:
    """Return True if the segment from ``eye`` to ``point`` meets the ball around ``middle``.

    All three are (3,), and ``radius`` is that of the ball.
    """
    along = 0.0
    total = 0.0
    squared_distance = 0.0
    for i in range(3):
        along += (point[i] - eye[i]) * (middle[i] - eye[i])
        total += (point[i] - eye[i]) ** 2
    # Fraction of the segment at the point that is nearest to the middle.
    fraction = min(max(along / total, 0.0), 1.0)
    for i in range(3):
        squared_distance += (eye[i] + fraction * (point[i] - eye[i]) - middle[i]) ** 2
    return squared_distance < radius * radius


@compiled
def to_body(move: Array, point: Array, into: Array) -> None:
    """Transform a point (3,) from camera axes to the axes of a body.

    ``move`` (4, 4) is camera_from_body, and ``into`` (3,) is filled.
    """
    for i in range(3):
        into[i] = 0.0
        for j in range(3):
            into[i] += move[j, i] * (point[j] - move[j, 3])


@compiled
def hidden_stickers(
    camera_from_bodies: Array,
    places: Array,
    normals: Array,
    owners: Array,
    clear: float,
    solids: Solids,
    tested: Array,
    hidden: Array,
) -> None:
    """Fill ``hidden`` (n,), which is True if a solid hides a part of a sticker's surroundings.

    The surroundings are a disc of radius ``clear`` m around the sticker's centre, in its plane. The
    centre and PROBES points on the rim are tested. ``camera_from_bodies`` (b, 4, 4) belong to the
    solids. Positions ``places`` (n, 3) and normals (n, 3) of stickers are in camera axes. The solid
    ``owners[n]``, to which sticker n belongs, does not hide it. Stickers outside the mask
    ``tested`` (n,) are not tested, and count as not hidden.
    """
    camera = np.zeros(3)
    eyes = np.empty((len(camera_from_bodies), 3))
    point = np.empty(3)
    probes = np.empty((1, PROBES + 1, 3))
    middles = np.empty((len(camera_from_bodies), 3))
    radii = np.full(1, clear)
    for b in range(len(camera_from_bodies)):
        to_body(camera_from_bodies[b], camera, eyes[b])
        transform_point(camera_from_bodies[b], solids.middles[b], 1.0, middles[b])
    for n in range(len(places)):
        hidden[n] = False
        if not tested[n]:
            continue
        probed = False
        for b in range(len(camera_from_bodies)):
            if b == owners[n] or hidden[n]:
                continue
            # Two cheap tests come first, because most solids are far from the line of sight.
            if not reaches(camera, places[n], middles[b], solids.radii[b] + clear):
                continue
            eye = eyes[b]
            to_body(camera_from_bodies[b], places[n], point)
            first = solids.starts[b]
            last = solids.starts[b + 1]
            faces = solids.normals[first:last]
            offsets = solids.offsets[first:last]
            if not occludes(eye, point, faces, offsets, clear, 0.0):
                continue
            if not probed:
                probe_discs(places[n : n + 1], normals[n : n + 1], radii, probes)
                probed = True
            for k in range(PROBES + 1):
                to_body(camera_from_bodies[b], probes[0, k], point)
                if occludes(eye, point, faces, offsets, 0.0, TOUCHING):
                    hidden[n] = True
                    break
