"""Compiled: discs as a camera sees them."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import compiled


@compiled
def project_disc(
    centre: np.ndarray,
    normal: np.ndarray,
    radius: float,
    focal: np.ndarray,
    principal: np.ndarray,
    middle: np.ndarray,
    shape: np.ndarray,
) -> None:
    """Ellipse of a disc, see ``projected_disc``: ``middle`` (2,) px and ``shape`` (2,2) px, the root of a matrix M:
    (M + d I) / sqrt(trace M + 2 d), d² = det M."""
    depth = centre[2] ** 2 - radius**2 * (1.0 - normal[2] ** 2)
    at = np.empty(2)
    for i in range(2):
        at[i] = (centre[i] * centre[2] + radius**2 * normal[i] * normal[2]) / depth
        middle[i] = focal[i] * at[i] + principal[i]
    for i in range(2):
        for j in range(2):
            across = 1.0 if i == j else 0.0
            dual = (centre[i] * centre[j] - radius**2 * (across - normal[i] * normal[j])) / depth
            shape[i, j] = focal[i] * focal[j] * (at[i] * at[j] - dual)
    d = math.sqrt(shape[0, 0] * shape[1, 1] - shape[0, 1] ** 2)
    scale = math.sqrt(shape[0, 0] + shape[1, 1] + 2.0 * d)
    shape[0, 0] += d
    shape[1, 1] += d
    for i in range(2):
        for j in range(2):
            shape[i, j] /= scale


@compiled
def project_all(
    centres: np.ndarray,
    normals: np.ndarray,
    radii: np.ndarray,
    focal: np.ndarray,
    principal: np.ndarray,
    middles: np.ndarray,
    shapes: np.ndarray,
) -> None:
    """``project_disc`` for n discs: centres (n,3), normals (n,3), radii (n,), middles (n,2), shapes (n,2,2)."""
    for n in range(len(centres)):
        project_disc(centres[n], normals[n], radii[n], focal, principal, middles[n], shapes[n])


@compiled
def place_discs(
    moves: np.ndarray,
    owners: np.ndarray,
    places: np.ndarray,
    directions: np.ndarray,
    centres: np.ndarray,
    normals: np.ndarray,
) -> None:
    """Centres and normals (n,3) in camera axes of discs at ``places`` with normals ``directions`` (n,3) in the axes of
    their ``owners`` (n,); moves (b,4,4) camera from bodies."""
    for n in range(len(places)):
        move = moves[owners[n]]
        for i in range(3):
            centres[n, i], normals[n, i] = move[i, 3], 0.0
            for j in range(3):
                centres[n, i] += move[i, j] * places[n, j]
                normals[n, i] += move[i, j] * directions[n, j]


@compiled
def probe_discs(centres: np.ndarray, normals: np.ndarray, radii: np.ndarray, probes: np.ndarray) -> None:
    """Fill probes (n,k,3): the middle of each disc, then k - 1 points on its rim."""
    count = probes.shape[1] - 1
    u = np.empty(3)
    for n in range(len(centres)):
        normal = normals[n]
        least = 0
        for i in range(1, 3):
            if abs(normal[i]) < abs(normal[least]):
                least = i
        length = math.sqrt(1.0 - normal[least] ** 2)
        i, j = (least + 1) % 3, (least + 2) % 3  # u = normal x e_least / length, which lies in the plane
        u[least], u[i], u[j] = 0.0, normal[j] / length, -normal[i] / length
        for k in range(count + 1):
            angle, distance = 2.0 * math.pi * k / count, 0.0 if k == 0 else radii[n]
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                v = normal[b] * u[c] - normal[c] * u[b]
                probes[n, k, a] = centres[n, a] + distance * (math.cos(angle) * u[a] + math.sin(angle) * v)
