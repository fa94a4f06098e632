"""Compiled: how well the fit of an ellipse would know it, and which stickers are hidden."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.detection.fit_kernels import (
    UNKNOWNS,
    FitSettings,
    accumulate,
    light_of_moving,
    mask_ring,
)
from cmmsim.geometry.point_kernels import factor, invert_factored


@compiled
def fit_covariances(
    centres: Array,
    shapes: Array,
    smears: Array,
    contrasts: Array,
    ground: float,
    size: int,
    settings: FitSettings,
    covariances: Array,
) -> None:
    """Fill covariances (n,m,m) of the first m parameters that ``fit_window`` would state of n ellipses that are as its
    model says: centres (n,2) in px of parts of ``size`` px, shapes (n,2,2), smears (n,2) px, contrasts (n,)."""
    mask, window = np.empty((size, size), np.bool_), np.empty((size, size))
    shares, derivatives = np.empty((size, size)), np.empty((size, size, 5))
    normal, right, parameters = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    for n in range(len(centres)):
        parameters[0], parameters[1] = centres[n, 0], centres[n, 1]
        mask_ring(parameters, shapes[n], settings.ring_reach, mask)
        light_of_moving(parameters, shapes[n], smears[n], settings, shares, derivatives)
        for i in range(size):
            for j in range(size):
                window[i, j] = ground + contrasts[n] * shares[i, j]
        accumulate(window, mask, shares, derivatives, contrasts[n], ground, settings, normal, right)
        factor(normal)
        invert_factored(normal, covariances[n])


@compiled
def reaches(eye: Array, point: Array, middle: Array, radius: float) -> bool:
    """Whether the line from ``eye`` to ``point`` (3,) comes within ``radius`` of ``middle`` (3,)."""
    along, total, gap = 0.0, 0.0, 0.0
    for i in range(3):
        along += (point[i] - eye[i]) * (middle[i] - eye[i])
        total += (point[i] - eye[i]) ** 2
    share = min(max(along / total, 0.0), 1.0)
    for i in range(3):
        gap += (eye[i] + share * (point[i] - eye[i]) - middle[i]) ** 2
    return gap < radius * radius


@compiled
def enters(eye: Array, point: Array, normals: Array, offsets: Array, touching: float) -> bool:
    """Whether the solid normal . x + offset <= 0 stands between ``eye`` and ``point`` (3,), all in its axes."""
    enter, leave = -np.inf, np.inf
    for k in range(len(normals)):
        distance, closing = -offsets[k], 0.0
        for i in range(3):
            distance -= normals[k, i] * eye[i]
            closing += normals[k, i] * (point[i] - eye[i])
        if closing < 0.0:
            enter = max(enter, distance / closing)
        elif closing > 0.0:
            leave = min(leave, distance / closing)
        elif distance < 0.0:
            return False
        if enter >= leave or leave <= 0.0 or enter >= 1.0 - touching:
            return False
    return True


@compiled
def to_body(move: Array, point: Array, into: Array) -> None:
    """Point (3,) in camera axes ``into`` axes of the body at camera_from_body ``move`` (4,4)."""
    for i in range(3):
        into[i] = 0.0
        for j in range(3):
            into[i] += move[j, i] * (point[j] - move[j, 3])


@compiled
def hidden_stickers(
    moves: Array,
    probes: Array,
    owners: Array,
    starts: Array,
    normals: Array,
    offsets: Array,
    middles: Array,
    radii: Array,
    touching: float,
    hidden: Array,
) -> None:
    """Fill ``hidden`` (n,): whether one of b convex solids stands before any of a sticker's ``probes`` (n,k,3).

    moves (b,4,4) camera_from_body; probes in camera axes, the sticker's middle first; owners (n,) the solids that carry
    the stickers, which do not hide them; solid b has the faces ``starts[b]`` to ``starts[b + 1]`` of normals (f,3) and
    offsets (f,), and lies in the ball of ``radii[b]`` about ``middles[b]`` (3,), in its axes.
    """
    camera, eye, point = np.zeros(3), np.empty(3), np.empty(3)
    for n in range(len(probes)):
        hidden[n] = False
        reach = 0.0
        for i in range(3):
            reach += (probes[n, 1, i] - probes[n, 0, i]) ** 2
        reach = math.sqrt(reach)
        for b in range(len(moves)):
            if b == owners[n] or hidden[n]:
                continue
            to_body(moves[b], camera, eye)
            to_body(moves[b], probes[n, 0], point)
            if not reaches(eye, point, middles[b], radii[b] + reach):
                continue
            first, last = starts[b], starts[b + 1]
            for k in range(probes.shape[1]):
                to_body(moves[b], probes[n, k], point)
                if enters(eye, point, normals[first:last], offsets[first:last], touching):
                    hidden[n] = True
                    break
