"""What the cameras look at: solid bodies and where the stickers really are. Only the renderer sees this truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import HalfspaceIntersection

from .marked_body import MarkedBody
from .pose import Array
from .sensor_file import Body, Stickers, unit

SUNK = 0.0003  # m the solid surface lies below the sticker planes
POLYGON_SIDES = 96


@dataclass(frozen=True)
class Patch:
    """A piece of a body drawn as one call: vertices (n,3) m, faces (m,3), levels (n,) 0 to 1 of its vertices."""

    vertices: Array
    faces: Array
    levels: Array


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
    """A bright disc and, in the same plane and with the same edge, its dark ring."""
    angles = 2.0 * np.pi * np.arange(POLYGON_SIDES) / POLYGON_SIDES
    circle = np.column_stack([np.cos(angles), np.sin(angles)]) @ axes.T
    # the polygon has the area of the circle
    fill = np.sqrt(2.0 * np.pi / (POLYGON_SIDES * np.sin(2.0 * np.pi / POLYGON_SIDES)))
    edge = place + fill * stickers.radius * circle
    vertices = np.concatenate([edge, edge, place + stickers.ring_radius * circle])
    n = POLYGON_SIDES
    k, following = np.arange(n), np.roll(np.arange(n), -1)
    disc = np.column_stack([np.zeros(n - 2, dtype=int), k[1:-1], k[2:]])
    ring = np.concatenate([np.column_stack([n + k, 2 * n + k, n + following]),
                           np.column_stack([n + following, 2 * n + k, 2 * n + following])])
    levels = np.repeat([stickers.sticker_level / 255.0, stickers.ring_level / 255.0], [n, 2 * n])
    return Patch(vertices, np.concatenate([disc, ring]), levels)
