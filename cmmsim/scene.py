"""What the cameras look at: solid bodies and where the stickers really are. Only the renderer sees this truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection

from .marked_body import MarkedBody
from .pose import Array
from .sensor_file import Body, Stickers, unit

SUNK = 0.0003  # m the solid surface lies below the sticker planes
RING_SUNK = 0.0001  # m the dark ring lies below its sticker
DISC_SIDES, RING_SIDES = 64, 16


@dataclass(frozen=True)
class Disc:
    """A flat disc: centre (3,) and radius m, outward unit normal (3,), level 0 to 1."""

    centre: Array
    normal: Array
    radius: float
    level: float


@dataclass(frozen=True)
class Patch:
    """A piece of a body drawn as one call: vertices (n,3) m, faces (m,3), levels (n,) 0 to 1 of its vertices.

    discs: what the mesh stands for when it is a sticker, the outer one first; empty for a solid in one level.
    """

    vertices: Array
    faces: Array
    levels: Array
    discs: tuple[Disc, ...] = ()


@dataclass(frozen=True)
class SceneBody:
    """A rigid body as drawn: its solid and one patch for each sticker; sticker_places (n,3) are the true ones, m."""

    solid: Patch
    stickers: tuple[Patch, ...]
    sticker_places: Array


def placed_stickers(body: MarkedBody, stickers: Stickers, stream: int) -> Array:
    """True sticker places (n,3): the nominal ones moved within their planes, by a seeded distance and direction."""
    rng = np.random.default_rng([stickers.placement_seed, stream])
    distance = rng.uniform(*stickers.placement, len(body.nominal))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(body.nominal))
    moves = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return body.nominal + np.einsum("nij,nj->ni", body.in_plane, moves)


def scene_body(body: MarkedBody, section: Body, stickers: Stickers, stream: int) -> SceneBody:
    """The drawn body of a sensor file's section."""
    places = placed_stickers(body, stickers, stream)
    patches = tuple(_sticker_patch(place, axes, stickers)
                    for place, axes in zip(places, body.in_plane, strict=True))
    solid = mesh_patch(_solid(body, section), stickers.body_level / 255.0)
    return SceneBody(solid, patches, places)


def mesh_patch(mesh: trimesh.Trimesh, level: float) -> Patch:
    """A mesh in one grey level."""
    vertices = np.asarray(mesh.vertices, dtype=float)
    return Patch(vertices, np.asarray(mesh.faces), np.full(len(vertices), level))


def rod(length: float, radius: float) -> trimesh.Trimesh:
    """A cylinder from the origin to (0, 0, length), m: a crank or a link between two points."""
    mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=24)
    mesh.apply_translation([0.0, 0.0, 0.5 * length])
    return mesh


def rod_transform(start: Array, end: Array) -> Array:
    """base_from_body (4,4) of a rod that begins at ``start`` (3,) and points to ``end`` (3,), m."""
    z = unit(np.asarray(end, dtype=float) - np.asarray(start, dtype=float))
    x = unit(np.cross(z, np.eye(3)[np.argmin(np.abs(z))]))
    transform = np.eye(4)
    transform[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    transform[:3, 3] = start
    return transform


def _solid(body: MarkedBody, section: Body) -> trimesh.Trimesh:
    """Convex solid of the sunk sticker planes and the cuts."""
    normals = [*body.normals, *(unit(c.normal) for c in section.cuts)]
    points = [*(d * n - SUNK * n for n, d in zip(body.normals, body.offsets, strict=True)),
              *(np.array(c.point) for c in section.cuts)]
    half_spaces = np.array([[*n, -(n @ p)] for n, p in zip(normals, points, strict=True)])
    inside = body.nominal.mean(axis=0) - 0.01 * body.normals.sum(axis=0)
    return trimesh.convex.convex_hull(HalfspaceIntersection(half_spaces, inside).intersections)


def _sticker_patch(place: Array, axes: Array, stickers: Stickers) -> Patch:
    """A bright disc, and RING_SUNK below it a dark one that shows as a ring."""
    vertices, faces, levels, first = [], [], [], 0
    discs: list[Disc] = []
    normal = np.cross(axes[:, 0], axes[:, 1])
    for sides, radius, sunk, level in ((DISC_SIDES, stickers.radius, 0.0, stickers.sticker_level),
                                       (RING_SIDES, stickers.ring_radius, RING_SUNK, stickers.ring_level)):
        angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
        fill = np.sqrt(2.0 * np.pi / (sides * np.sin(2.0 * np.pi / sides)))  # the polygon has the circle's area
        circle = fill * radius * np.column_stack([np.cos(angles), np.sin(angles)]) @ axes.T
        vertices.append(place - sunk * normal + circle)
        discs.insert(0, Disc(place - sunk * normal, normal, radius, level / 255.0))
        faces.append(first + _balanced_triangles(sides))
        levels.append(np.full(sides, level / 255.0))
        first += sides
    return Patch(np.concatenate(vertices), np.concatenate(faces), np.concatenate(levels), tuple(discs))


def _balanced_triangles(sides: int) -> NDArray[np.int_]:
    """Triangles (sides - 2, 3) of a convex polygon, large ones inside: faster to draw than a fan of slivers."""
    triangles: list[tuple[int, int, int]] = []
    arcs = [(0, sides - 1)]
    while arcs:
        start, end = arcs.pop()
        if end - start >= 2:
            middle = (start + end) // 2
            triangles.append((start, middle, end))
            arcs += [(start, middle), (middle, end)]
    return np.array(triangles)
