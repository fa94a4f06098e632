"""Compiled functions that draw layers of convex solids and discs, see ``analytic``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.rim_kernels import cover_window


class Solids(NamedTuple):
    """Outlines of solids in an image, from far to near.

    ``half_planes`` (m, 3) contains a, b, c of a x + b y <= c, px. The slice starts[k]:starts[k + 1]
    belongs to solid k. ``boxes`` (s, 4) are lowest x, y and highest x, y, px, and ``levels`` (s,)
    the radiances of the s solids. ``draw_solids`` stores the fractions of pixels that solid k
    covers in ``covers[slots[k]]``, or nowhere if ``slots[k]`` is -1.
    """

    half_planes: Array
    starts: Array
    boxes: Array
    levels: Array
    slots: Array


class Discs(NamedTuple):
    """Discs in the order in which they are drawn.

    Their ellipses have centres (m, 2), shapes (m, 2, 2) and half extents (m, 2), px. ``levels``
    (m,) are radiances. ``behind`` (m, slots) is True if a disc lies behind the solid of a slot.
    """

    centres: Array
    shapes: Array
    extents: Array
    levels: Array
    behind: Array


@compiled
def polygon_contains(half_planes: Array, x: float, y: float, width: int, height: int) -> bool:
    """Tell whether a box with its top-left corner at (x, y) lies wholly inside a convex polygon."""
    for k in range(len(half_planes)):
        a, b, c = half_planes[k]
        if max(a * x, a * (x + width)) + max(b * y, b * (y + height)) > c:
            return False
    return True


@compiled
def cover_by_polygon(half_planes: Array, x: float, y: float, lines: int, share: Array) -> None:
    """Fill ``share`` (h, w) with the fraction of each pixel that a convex polygon covers.

    The top-left corner of the first pixel is (x, y). The fraction is exact along x, and along y it
    is the mean over ``lines`` scan lines.
    """
    height, width = share.shape
    share[:] = 0.0
    for row in range(height):
        for line in range(lines):
            line_y = y + row + (line + 0.5) / lines
            left = 0.0
            right = float(width)
            for k in range(len(half_planes)):
                a, b, c = half_planes[k]
                # Each half plane limits the covered part of the scan line at one end.
                room = c - b * line_y - a * x
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
def draw_solids(
    image: Array, x: float, y: float, solids: Solids, lines: int, covers: Array
) -> None:
    """Draw solids over a window (h, w) and store the fractions of pixels that they cover.

    The top-left corner of the window is (x, y). ``covers`` (slots, h, w) gets the fractions of
    solids that have a slot.
    """
    height, width = image.shape
    share = np.empty((height, width))
    for k in range(len(solids.levels)):
        low_x, low_y, high_x, high_y = solids.boxes[k]
        if high_x <= x or low_x >= x + width or high_y <= y or low_y >= y + height:
            continue
        half_planes = solids.half_planes[solids.starts[k] : solids.starts[k + 1]]
        if polygon_contains(half_planes, x, y, width, height):
            share[:] = 1.0
        else:
            cover_by_polygon(half_planes, x, y, lines, share)
        for row in range(height):
            for column in range(width):
                image[row, column] += share[row, column] * (solids.levels[k] - image[row, column])
                if solids.slots[k] >= 0:
                    covers[solids.slots[k], row, column] = share[row, column]


@compiled
def visible_share(behind: Array, covers: Array, row: int, column: int) -> float:
    """Return the fraction of a pixel that no solid in front of a disc covers."""
    shown = 1.0
    for slot in range(len(behind)):
        if behind[slot]:
            shown *= 1.0 - covers[slot, row, column]
    return shown


@compiled
def draw_disc(
    image: Array, centre_x: float, centre_y: float, k: int, discs: Discs, covers: Array
) -> None:
    """Draw disc ``k`` over a window (h, w), with its centre relative to the first pixel, px."""
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
                own[column] *= visible_share(discs.behind[k], covers, row, first + column)
        for column in range(len(own)):
            under[column] += own[column] * (level - under[column])


@compiled
def draw_layers(
    images: Array, group: Array, corners: Array, solids: Solids, lines: int, discs: Discs
) -> None:
    """Draw solids, then discs, over the windows ``images[group]`` (n, h, w).

    The windows have first pixels ``corners`` (n, 2).
    """
    _, height, width = images.shape
    covers = np.empty((discs.behind.shape[1], height, width))
    for n in range(len(group)):
        image = images[group[n]]
        x = corners[n, 0]
        y = corners[n, 1]
        covers[:] = 0.0
        draw_solids(image, x - 0.5, y - 0.5, solids, lines, covers)
        for k in range(len(discs.levels)):
            centre_x = discs.centres[k, 0] - x
            centre_y = discs.centres[k, 1] - y
            if (
                centre_x + discs.extents[k, 0] > -0.5
                and centre_x - discs.extents[k, 0] < width - 0.5
                and centre_y + discs.extents[k, 1] > -0.5
                and centre_y - discs.extents[k, 1] < height - 0.5
            ):
                draw_disc(image, centre_x, centre_y, k, discs, covers)


@compiled
def occludes(
    eye: Array, point: Array, normals: Array, offsets: Array, wider: float, touching: float
) -> bool:
    """Tell whether a solid stands between ``eye`` (3,) and ``point`` (3,).

    The solid, enlarged by ``wider`` m on all sides, consists of the points x with normal . x +
    offset <= ``wider`` for all faces. All coordinates are in the solid's axes. A point counts as
    lying on the solid, and not behind it, if the line of sight enters the solid within the final
    fraction ``touching`` of the line's length.
    """
    enter = -np.inf
    leave = np.inf
    for k in range(len(normals)):
        distance = wider - offsets[k]
        closing = 0.0
        for i in range(3):
            distance -= normals[k, i] * eye[i]
            closing += normals[k, i] * (point[i] - eye[i])
        # The line of sight enters the solid at the last face that it crosses inwards, and leaves
        # the solid at the first face that it crosses outwards.
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
def occluded_points(
    body_from_camera: Array,
    points: Array,
    normals: Array,
    offsets: Array,
    touching: float,
    hidden: Array,
) -> None:
    """Fill ``hidden`` (n,) with whether a convex solid stands between the camera and each point.

    The points (n, 3) are in camera axes. The solid is normal . x + offset <= 0 in its own axes.
    """
    eye = np.empty(3)
    point = np.empty(3)
    for n in range(len(points)):
        for i in range(3):
            point[i] = eye[i] = body_from_camera[i, 3]
            for j in range(3):
                point[i] += body_from_camera[i, j] * points[n, j]
        hidden[n] = occludes(eye, point, normals, offsets, 0.0, touching)
