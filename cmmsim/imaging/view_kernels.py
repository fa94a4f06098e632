"""Compiled functions that draw a scene of discs and convex solids, see ``analytic``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.disc_kernels import place_discs, probe_discs, project_all
from cmmsim.imaging.layer_kernels import Discs, Solids, draw_layers, occludes

# Number of points on a disc's rim that are tested, in addition to its centre, for solids in front.
PROBES = 8
# m: a solid with a vertex at a smaller depth is not drawn.
NEAREST = 1e-3


class Scene(NamedTuple):
    """Discs and convex solids, in the axes of their bodies. Levels are radiances 0 to 1.

    places, normals             (m, 3), centres and normals of the discs
    radii, disc_levels          (m,), radii and levels of the discs
    owners                      (m,), bodies to which the discs belong
    bodies, levels              (s,), bodies and levels of the solids
    middles                     (s, 3), means of the vertices of the solids
    vertices                    (v, 3), vertices of all solids
    vertex_starts               (s + 1,), vertices of solid k begin at vertex_starts[k]
    face_normals, face_offsets  faces of all solids: normal . x + offset <= 0 inside
    face_starts                 (s + 1,), faces of solid k begin at face_starts[k]
    """

    places: Array
    normals: Array
    radii: Array
    disc_levels: Array
    owners: Array
    bodies: Array
    levels: Array
    middles: Array
    vertices: Array
    vertex_starts: Array
    face_normals: Array
    face_offsets: Array
    face_starts: Array


@compiled
def place_rods(starts: Array, ends: Array, transforms: Array, lengths: Array) -> None:
    """Fill ``transforms`` with base_from_body (k, 4, 4) of rods, and ``lengths`` (k,).

    The rods lead from ``starts`` to ``ends`` (k, 3) along their z axes. Each x axis is
    perpendicular to the rod, and to the base axis that forms the largest angle with the rod.
    ``transforms`` must contain zeros. A rod without length gets NaN.
    """
    for k in range(len(starts)):
        move = transforms[k]
        squared = 0.0
        aside = 0
        for i in range(3):
            move[i, 2] = ends[k, i] - starts[k, i]
            move[i, 3] = starts[k, i]
            squared += move[i, 2] ** 2
        lengths[k] = math.sqrt(squared)
        for i in range(3):
            move[i, 2] /= lengths[k]
            aside = i if abs(move[i, 2]) < abs(move[aside, 2]) else aside
        after = (aside + 1) % 3
        before = (aside + 2) % 3
        across = math.sqrt(move[after, 2] ** 2 + move[before, 2] ** 2)
        move[after, 0] = move[before, 2] / across
        move[before, 0] = -move[after, 2] / across
        for i in range(3):
            j = (i + 1) % 3
            m = (i + 2) % 3
            move[i, 1] = move[j, 2] * move[m, 0] - move[m, 2] * move[j, 0]
        move[3, 3] = 1.0


@compiled
def convex_hull(points: Array) -> Array:
    """Return corners (k, 2) of the convex hull of points (n, 2), by Andrew's monotone chain.

    ``points`` is sorted in place.
    """
    n = len(points)
    # Insertion sort by x, then y; the points are few.
    for i in range(1, n):
        for j in range(i, 0, -1):
            before = points[j - 1]
            after = points[j]
            if before[0] < after[0] or (before[0] == after[0] and before[1] <= after[1]):
                break
            for axis in range(2):
                before[axis], after[axis] = after[axis], before[axis]
    hull = np.empty((2 * n, 2))
    count = 0
    for way in range(2):
        least = count + 1
        for step in range(n):
            point = points[step if way == 0 else n - 1 - step]
            while count > least:
                a = hull[count - 2]
                b = hull[count - 1]
                if (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) > 0.0:
                    break
                count -= 1
            hull[count, 0] = point[0]
            hull[count, 1] = point[1]
            count += 1
        count -= 1  # the last point of one chain is the first point of the other
    return hull[: max(count, 1)]


@compiled
def half_planes_of(corners: Array, half_planes: Array) -> int:
    """Fill ``half_planes`` with a, b, c of a x + b y <= c for the sides of a convex polygon.

    The polygon has ``corners`` (n, 2), px. Sides shorter than about 1e-6 px are omitted. The result
    is the number of half planes.
    """
    n = len(corners)
    count = 0
    middle_x = 0.0
    middle_y = 0.0
    for k in range(n):
        middle_x += corners[k, 0] / n
        middle_y += corners[k, 1] / n
    for k in range(n):
        x, y = corners[k]
        a = corners[(k + 1) % n, 1] - y
        b = x - corners[(k + 1) % n, 0]
        if abs(a) + abs(b) > 1e-6:
            outwards = 1.0 if a * (x - middle_x) + b * (y - middle_y) > 0.0 else -1.0
            half_planes[count, 0] = outwards * a
            half_planes[count, 1] = outwards * b
            half_planes[count, 2] = outwards * (a * x + b * y)
            count += 1
    return count


@compiled
def visible_discs(
    scene: Scene, camera_from_bodies: Array, focal: Array, principal: Array, near: float
) -> tuple:
    """Return the discs that face the camera, from far to near; at equal depth, larger ones first.

    The results are the indices (m,) of the discs, the centres (m, 2), shapes (m, 2, 2) and half
    extents (m, 2) of their ellipses in px, and the ``probes`` (m, k, 3), points on the discs that
    are tested for occlusion, in camera axes, m. Discs that may reach nearer than ``near`` m are
    omitted.
    """
    total = len(scene.radii)
    places = np.empty((total, 3))
    normals = np.empty((total, 3))
    place_discs(camera_from_bodies, scene.owners, scene.places, scene.normals, places, normals)
    kept = np.empty(total, np.int64)
    count = 0
    for n in range(total):
        facing = (
            places[n, 0] * normals[n, 0]
            + places[n, 1] * normals[n, 1]
            + places[n, 2] * normals[n, 2]
            < 0.0
        )
        if not (facing and places[n, 2] - scene.radii[n] > near):
            continue
        # Depths are rounded to millimetres, so that the discs of a sticker are ordered by radius.
        depth = np.rint(1e3 * places[n, 2])
        rank = count
        while rank > 0:
            other = kept[rank - 1]
            other_depth = np.rint(1e3 * places[other, 2])
            if other_depth > depth or (
                other_depth == depth and scene.radii[other] >= scene.radii[n]
            ):
                break
            kept[rank] = other
            rank -= 1
        kept[rank] = n
        count += 1
    kept = kept[:count]
    pixels = np.empty((count, 2))
    shapes = np.empty((count, 2, 2))
    extents = np.empty((count, 2))
    probes = np.empty((count, PROBES + 1, 3))
    places = places[kept]
    normals = normals[kept]
    radii = scene.radii[kept]
    project_all(places, normals, radii, focal, principal, pixels, shapes)
    probe_discs(places, normals, radii, probes)
    for n in range(count):
        for i in range(2):
            extents[n, i] = np.sqrt(shapes[n, i, 0] ** 2 + shapes[n, i, 1] ** 2)
    return kept, pixels, shapes, extents, probes


@compiled
def occlusion_mask(
    scene: Scene,
    camera_from_bodies: Array,
    owners: Array,
    probes: Array,
    near: float,
    touching: float,
    slots: Array,
) -> Array:
    """Return a mask (m, h) that states which discs lie behind which solids.

    A disc lies behind a solid of another body that hides one of its probes. Only the h solids that
    hide at least one disc have a column. ``slots`` (s,) is filled with the column of each solid, or
    -1. The discs belong to bodies ``owners`` (m,) and have ``probes`` (m, k, 3) from
    ``visible_discs``. A solid whose body's origin lies more than ``near`` m behind the camera hides
    nothing. ``touching`` is that of ``occludes``.
    """
    behind = np.zeros((len(owners), len(slots)), np.bool_)
    hiding = 0
    eye = np.empty(3)
    point = np.empty(3)
    for k in range(len(slots)):
        slots[k] = -1
        move = camera_from_bodies[scene.bodies[k]]
        # A body behind the camera hides nothing.
        if move[2, 3] < -near:
            continue
        own = slice(scene.face_starts[k], scene.face_starts[k + 1])
        for i in range(3):
            eye[i] = -(move[0, i] * move[0, 3] + move[1, i] * move[1, 3] + move[2, i] * move[2, 3])
        for n in range(len(owners)):
            if owners[n] == scene.bodies[k]:
                continue
            for p in range(probes.shape[1]):
                for i in range(3):
                    point[i] = eye[i]
                    for j in range(3):
                        point[i] += move[j, i] * probes[n, p, j]
                if occludes(
                    eye, point, scene.face_normals[own], scene.face_offsets[own], 0.0, touching
                ):
                    slots[k] = hiding
                    behind[n, hiding] = True
                    break
        hiding += slots[k] >= 0
    return behind[:, :hiding]


@compiled
def solid_outlines(
    scene: Scene, camera_from_bodies: Array, focal: Array, principal: Array, slots: Array
) -> Solids:
    """Return the outlines of solids that lie wholly in front of the camera, from far to near.

    ``slots`` (s,) come from ``occlusion_mask`` and are passed on in the result.
    """
    total = len(slots)
    depths = np.empty(total)
    half_planes = np.empty((len(scene.vertices), 3))
    for k in range(total):
        move = camera_from_bodies[scene.bodies[k]]
        middle = scene.middles[k]
        depths[k] = (
            move[2, 0] * middle[0] + move[2, 1] * middle[1] + move[2, 2] * middle[2] + move[2, 3]
        )
    order = np.argsort(depths)[::-1]
    starts = np.zeros(total + 1, np.int64)
    boxes = np.empty((total, 4))
    shown = np.empty(total, np.int64)
    filled = 0
    for k in order:
        move = camera_from_bodies[scene.bodies[k]]
        vertices = scene.vertices[scene.vertex_starts[k] : scene.vertex_starts[k + 1]]
        pixels = np.empty((len(vertices), 2))
        nearest = np.inf
        for v in range(len(vertices)):
            x, y, z = vertices[v]
            depth = move[2, 0] * x + move[2, 1] * y + move[2, 2] * z + move[2, 3]
            nearest = min(nearest, depth)
            for i in range(2):
                coordinate = move[i, 0] * x + move[i, 1] * y + move[i, 2] * z + move[i, 3]
                # Single precision is sufficient for edges in an image.
                pixels[v, i] = np.float32(coordinate / depth * focal[i] + principal[i])
        if nearest <= NEAREST:
            continue
        hull = convex_hull(pixels)
        for i in range(2):
            boxes[filled, i] = hull[:, i].min()
            boxes[filled, 2 + i] = hull[:, i].max()
        first = starts[filled]
        starts[filled + 1] = first + half_planes_of(hull, half_planes[first:])
        shown[filled] = k
        filled += 1
    shown = shown[:filled]
    return Solids(
        half_planes, starts[: filled + 1], boxes[:filled], scene.levels[shown], slots[shown]
    )


@compiled
def draw_view(
    scene: Scene,
    camera_from_bodies: Array,
    focal: Array,
    principal: Array,
    near: float,
    touching: float,
    images: Array,
    group: Array,
    corners: Array,
    lines: int,
) -> None:
    """Draw the windows ``images[group]`` (n, h, w) of one exposure of a camera with a perfect lens.

    The windows have first pixels ``corners`` (n, 2) and already contain the background. The camera
    has the focal lengths ``focal`` (2,) and the principal point ``principal`` (2,), px.
    ``camera_from_bodies`` are the transforms camera_from_body (b, 4, 4). ``lines`` is the number of
    scan lines per pixel that sample edges of solids. See ``visible_discs`` for ``near`` and
    ``occludes`` for ``touching``.
    """
    kept, pixels, shapes, extents, probes = visible_discs(
        scene, camera_from_bodies, focal, principal, near
    )
    slots = np.empty(len(scene.bodies), np.int64)
    behind = occlusion_mask(
        scene, camera_from_bodies, scene.owners[kept], probes, near, touching, slots
    )
    solids = solid_outlines(scene, camera_from_bodies, focal, principal, slots)
    discs = Discs(pixels, shapes, extents, scene.disc_levels[kept], behind)
    draw_layers(images, group, corners, solids, lines, discs)
