"""Compiled: the stickers that convex solids hide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.disc_kernels import probe_discs
from cmmsim.geometry.transform_kernels import carry
from cmmsim.imaging.layer_kernels import enters

# Points about a sticker that are probed, with its middle, for solids that hide them.
PROBES = 12
# Share of the way to a point in which meeting a solid counts as lying on it.
TOUCHING = 1e-6


class Solids(NamedTuple):
    """Convex solids in their own axes.

    The faces of solid b are ``starts[b]`` to ``starts[b + 1]`` of outward normals (f, 3) and
    offsets (f,). The ball of ``radii[b]`` about ``middles[b]`` (3,) holds all of it.
    """

    starts: Array
    normals: Array
    offsets: Array
    middles: Array
    radii: Array


@compiled
def reaches(eye: Array, point: Array, middle: Array, radius: float) -> bool:
    """Tell whether the line from ``eye`` to ``point`` (3,) comes within ``radius`` of ``middle``
    (3,).
    """
    along = 0.0
    total = 0.0
    gap = 0.0
    for i in range(3):
        along += (point[i] - eye[i]) * (middle[i] - eye[i])
        total += (point[i] - eye[i]) ** 2
    # The point of the line of sight, between its ends, that is nearest to the middle.
    share = min(max(along / total, 0.0), 1.0)
    for i in range(3):
        gap += (eye[i] + share * (point[i] - eye[i]) - middle[i]) ** 2
    return gap < radius * radius


@compiled
def to_body(move: Array, point: Array, into: Array) -> None:
    """Carry a point (3,) in camera axes into axes of the body at camera_from_body ``move`` (4,
    4).
    """
    for i in range(3):
        into[i] = 0.0
        for j in range(3):
            into[i] += move[j, i] * (point[j] - move[j, 3])


@compiled
def hidden_stickers(
    moves: Array,
    places: Array,
    normals: Array,
    owners: Array,
    clear: float,
    solids: Solids,
    asked: Array,
    hidden: Array,
) -> None:
    """Fill ``hidden`` (n,): whether a solid stands before any point within ``clear`` m of a
    sticker.

    The points lie in the sticker's plane. ``moves`` (b, 4, 4) are camera_from_body of the solids;
    places and normals (n, 3) of stickers are in camera axes. The solids ``owners`` (n,) carry them
    and do not hide them. Only stickers that are ``asked`` (n,) are looked at.
    """
    camera = np.zeros(3)
    eyes = np.empty((len(moves), 3))
    point = np.empty(3)
    probes = np.empty((1, PROBES + 1, 3))
    middles = np.empty((len(moves), 3))
    reach = np.full(1, clear)
    for b in range(len(moves)):
        to_body(moves[b], camera, eyes[b])
        carry(moves[b], solids.middles[b], 1.0, middles[b])
    for n in range(len(places)):
        hidden[n] = False
        if not asked[n]:
            continue
        probed = False
        for b in range(len(moves)):
            if b == owners[n] or hidden[n]:
                continue
            # Two cheap tests first: most solids are far from the line of sight.
            if not reaches(camera, places[n], middles[b], solids.radii[b] + clear):
                continue
            eye = eyes[b]
            to_body(moves[b], places[n], point)
            first = solids.starts[b]
            last = solids.starts[b + 1]
            faces = solids.normals[first:last]
            offsets = solids.offsets[first:last]
            if not enters(eye, point, faces, offsets, clear, 0.0):
                continue
            if not probed:
                probe_discs(places[n : n + 1], normals[n : n + 1], reach, probes)
                probed = True
            for k in range(PROBES + 1):
                to_body(moves[b], probes[0, k], point)
                if enters(eye, point, faces, offsets, 0.0, TOUCHING):
                    hidden[n] = True
                    break
