"""Compiled: layers of convex solids and discs, drawn without OpenGL, see ``analytic``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.rim_kernels import cover_window


class Solids(NamedTuple):
    """Solids from far to near.

    ``half_planes`` (m, 3) are a, b, c of a x + b y <= c, px; those of solid k stand from starts[k]
    to starts[k + 1]. ``boxes`` (k, 4) are lowest x, y and highest x, y. ``slots`` (k,) are the
    indices at which the covers of solids are stored, or -1.
    """

    half_planes: Array
    starts: Array
    boxes: Array
    levels: Array
    slots: Array


class Discs(NamedTuple):
    """Discs in the order in which they are laid.

    Their ellipses have centres (m, 2), shapes (m, 2, 2) and half extents (m, 2), px. ``behind`` (m,
    slots) says whether the solid of that slot stands before the disc.
    """

    centres: Array
    shapes: Array
    extents: Array
    levels: Array
    behind: Array


@compiled
def polygon_holds(half_planes: Array, x: float, y: float, width: int, height: int) -> bool:
    """Tell whether the box from (x, y) on lies wholly inside a convex polygon."""
    for k in range(len(half_planes)):
        a, b, c = half_planes[k]
        if max(a * x, a * (x + width)) + max(b * y, b * (y + height)) > c:
            return False
    return True


@compiled
def cover_by_polygon(half_planes: Array, x: float, y: float, lines: int, share: Array) -> None:
    """Fill the share (h, w) of the pixels of a box from (x, y) on that a convex polygon covers.

    It is exact along x, and the mean of ``lines`` scan lines along y.
    """
    height, width = share.shape
    share[:] = 0.0
    for row in range(height):
        for line in range(lines):
            at = y + row + (line + 0.5) / lines
            left = 0.0
            right = float(width)
            for k in range(len(half_planes)):
                a, b, c = half_planes[k]
                # Each half plane shortens the scan line from one of its ends.
                room = c - b * at - a * x
                if a > 0.0:
                    right = min(right, room / a)
                elif a < 0.0:
                    left = max(left, room / a)
                elif room < 0.0:
                    right = 0.0
            if left < right:
                for column in range(int(left), min(math.ceil(right), width)):
                    share[row, column] += (
                        min(right, column + 1.0) - max(left, float(column))
                    ) / lines


@compiled
def lay_solids(image: Array, x: float, y: float, solids: Solids, lines: int, covers: Array) -> None:
    """Lay solids over a window (h, w) whose first pixel begins at (x, y), and note their covers."""
    height, width = image.shape
    share = np.empty((height, width))
    for k in range(len(solids.levels)):
        low_x, low_y, high_x, high_y = solids.boxes[k]
        if high_x <= x or low_x >= x + width or high_y <= y or low_y >= y + height:
            continue
        half_planes = solids.half_planes[solids.starts[k] : solids.starts[k + 1]]
        if polygon_holds(half_planes, x, y, width, height):
            share[:] = 1.0
        else:
            cover_by_polygon(half_planes, x, y, lines, share)
        for row in range(height):
            for column in range(width):
                image[row, column] += share[row, column] * (solids.levels[k] - image[row, column])
                if solids.slots[k] >= 0:
                    covers[solids.slots[k], row, column] = share[row, column]


@compiled
def shown_share(behind: Array, covers: Array, row: int, column: int) -> float:
    """Return the share of a pixel that none of the solids before a disc covers."""
    shown = 1.0
    for slot in range(len(behind)):
        if behind[slot]:
            shown *= 1.0 - covers[slot, row, column]
    return shown


@compiled
def lay_disc(
    image: Array, centre_x: float, centre_y: float, k: int, discs: Discs, covers: Array
) -> None:
    """Lay disc ``k`` over a window (h, w), its centre given in px of the window."""
    height, width = image.shape
    extent_x, extent_y = discs.extents[k]
    first = max(0, math.ceil(centre_x - extent_x - 0.5))
    last = min(width, math.floor(centre_x + extent_x + 1.5))
    top = max(0, math.ceil(centre_y - extent_y - 0.5))
    bottom = min(height, math.floor(centre_y + extent_y + 1.5))
    if first >= last or top >= bottom:
        return
    shares = np.empty((bottom - top, last - first))
    none = np.empty((0, 0, 5))
    cover_window(centre_x - first, centre_y - top, discs.shapes[k], shares, none)
    level = discs.levels[k]
    for row in range(top, bottom):
        own = shares[row - top]
        under = image[row, first:last]
        if discs.behind[k].any():
            for column in range(len(own)):
                own[column] *= shown_share(discs.behind[k], covers, row, first + column)
        for column in range(len(own)):
            under[column] += own[column] * (level - under[column])


@compiled
def lay_layers(
    images: Array, group: Array, corners: Array, solids: Solids, lines: int, discs: Discs
) -> None:
    """Lay solids, then discs, over the windows ``images[group]`` (h, w) with first pixels (n,
    2).
    """
    _, height, width = images.shape
    covers = np.empty((discs.behind.shape[1], height, width))
    for n in range(len(group)):
        image = images[group[n]]
        x = corners[n, 0]
        y = corners[n, 1]
        covers[:] = 0.0
        lay_solids(image, x - 0.5, y - 0.5, solids, lines, covers)
        for k in range(len(discs.levels)):
            gap_x = discs.centres[k, 0] - x
            gap_y = discs.centres[k, 1] - y
            if (
                gap_x + discs.extents[k, 0] > -0.5
                and gap_x - discs.extents[k, 0] < width - 0.5
                and gap_y + discs.extents[k, 1] > -0.5
                and gap_y - discs.extents[k, 1] < height - 0.5
            ):
                lay_disc(image, gap_x, gap_y, k, discs, covers)


@compiled
def enters(
    eye: Array, point: Array, normals: Array, offsets: Array, wider: float, touching: float
) -> bool:
    """Tell whether the solid normal . x + offset <= ``wider`` stands between ``eye`` and ``point``
    (3,).

    All are in its axes. Meeting the solid within the share ``touching`` of the way to the point
    counts as the point's lying on it.
    """
    enter = -np.inf
    leave = np.inf
    for k in range(len(normals)):
        distance = wider - offsets[k]
        closing = 0.0
        for i in range(3):
            distance -= normals[k, i] * eye[i]
            closing += normals[k, i] * (point[i] - eye[i])
        # Each face cuts the way from the eye to the point: the solid is entered at the last face
        # that is met from outside, and left at the first one from inside.
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
def hidden_points(
    body_from_camera: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    touching: float,
    hidden: Array,
) -> None:
    """Fill ``hidden`` (n,): whether a convex solid stands between the camera and points (n, 3).

    The points are in camera axes. The solid is normal . x + offset <= 0 in its own axes.
    """
    eye = np.empty(3)
    point = np.empty(3)
    for n in range(len(points)):
        for i in range(3):
            point[i] = eye[i] = body_from_camera[i, 3]
            for j in range(3):
                point[i] += body_from_camera[i, j] * points[n, j]
        hidden[n] = enters(eye, point, normals, offsets, 0.0, touching)
