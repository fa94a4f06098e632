"""Compiled functions that paint stickers and a bright background into drawn windows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled


class Painted(NamedTuple):
    """Stickers that a camera sees, with their print and light.

    to_stickers   (n, 3, 3), matrices that map homogeneous pixels to (u, v, 1) on the stickers, with
                  u and v in radii
    to_places     (n, 2, 2), derivatives d(u, v) / d(pixels) at the centres
    boxes         (n, 4), lowest x, y and highest x, y of the rings, px
    slopes        (n, 2), apparent shifts in (u, v) of the lower edges of the rims
    shifts        (n, 2), apparent shifts in (u, v) of the stickers by retro-reflection
    lights        (n, 3), light at the centres, and its changes over a radius along u and v
    faces         (n,), levels of the stickers in full light
    ring, rim     levels of the rings and of the rims
    prints        (n, 5), coefficients of the modes of brightness
    outlines      (n, 8), coefficients of the harmonics 2 to 5 of the outline
    """

    to_stickers: Array
    to_places: Array
    boxes: Array
    slopes: Array
    shifts: Array
    lights: Array
    faces: Array
    ring: float
    rim: float
    prints: Array
    outlines: Array


@compiled
def print_at(prints: Array, u: float, v: float) -> float:
    """Return the relative brightness at (u, v), or at the nearest point of the unit disc."""
    size = math.sqrt(u * u + v * v)
    if size > 1.0:
        u /= size
        v /= size
    return (
        1.0
        + 2.0 * (prints[0] * u + prints[1] * v)
        + math.sqrt(24.0) * prints[2] * u * v
        + math.sqrt(6.0) * prints[3] * (u * u - v * v)
        + math.sqrt(12.0) * prints[4] * (u * u + v * v - 0.5)
    )


@compiled
def outline_at(outlines: Array, u: float, v: float) -> float:
    """Return the radius of the outline in the direction of (u, v), in radii of the sticker."""
    size = math.sqrt(u * u + v * v)
    if size == 0.0:
        return 1.0
    cosine = u / size
    sine = v / size
    radius = 1.0
    real = cosine
    imaginary = sine
    for k in range(len(outlines) // 2):
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        radius += outlines[2 * k] * real + outlines[2 * k + 1] * imaginary
    return radius


@compiled
def covered(u: float, v: float, radius: float, to_places: Array) -> float:
    """Return the fraction of a pixel at (u, v) that a disc of the given radius covers.

    Inside the pixel, the rim counts as straight. ``to_places`` (2, 2) is the derivative d(u, v) /
    d(pixels).
    """
    size = math.sqrt(u * u + v * v)
    if size < 1e-6:
        return 1.0
    x = (to_places[0, 0] * u + to_places[1, 0] * v) / size
    y = (to_places[0, 1] * u + to_places[1, 1] * v) / size
    return min(max(0.5 - (size - radius) / math.sqrt(x * x + y * y), 0.0), 1.0)


@compiled
def paint_window(image: Array, shown: Array, corner: Array, n: int, painted: Painted) -> None:
    """Paint sticker ``n`` into a window (h, w), weighted by the visible fraction ``shown`` (h, w).

    The window already contains the empty ring, whose level is replaced. ``corner`` (2,) is the
    first pixel of the window.
    """
    height, width = image.shape
    box = painted.boxes[n]
    slope = painted.slopes[n]
    shift = painted.shifts[n]
    light = painted.lights[n]
    outlines = painted.outlines[n]
    to_sticker = painted.to_stickers[n]
    to_places = painted.to_places[n]
    first = max(0, int(box[0] - corner[0]))
    last = min(width, int(box[2] - corner[0]) + 2)
    squared = slope[0] * slope[0] + slope[1] * slope[1]
    for row in range(max(0, int(box[1] - corner[1])), min(height, int(box[3] - corner[1]) + 2)):
        y = row + corner[1]
        for column in range(first, last):
            share = shown[row, column]
            if share == 0.0:
                continue
            x = column + corner[0]
            scale = to_sticker[2, 0] * x + to_sticker[2, 1] * y + to_sticker[2, 2]
            u = (to_sticker[0, 0] * x + to_sticker[0, 1] * y + to_sticker[0, 2]) / scale
            v = (to_sticker[1, 0] * x + to_sticker[1, 1] * y + to_sticker[1, 2]) / scale
            lit = max(light[0] + light[1] * u + light[2] * v, 0.0)
            u -= shift[0]
            v -= shift[1]
            level = painted.ring
            if u * u + v * v < 4.0:
                own = covered(u, v, outline_at(outlines, u, v), to_places)
                face = painted.faces[n] * max(print_at(painted.prints[n], u, v), 0.0)
                level += own * (face - painted.ring)
                if squared > 0.0 and own < 1.0:
                    # Depth of the rim's part that this pixel shows best, in thicknesses.
                    depth = (u * slope[0] + v * slope[1]) / squared
                    depth = min(max(depth, 0.0), 1.0)
                    low_u = u - depth * slope[0]
                    low_v = v - depth * slope[1]
                    radius = outline_at(outlines, low_u, low_v)
                    aside = max(covered(low_u, low_v, radius, to_places) - own, 0.0)
                    level += aside * (painted.rim - painted.ring)
            image[row, column] += share * (lit * level - painted.ring)


@compiled
def paint_view(images: Array, shown: Array, group: Array, corners: Array, painted: Painted) -> None:
    """Paint all stickers into the windows ``images[group]`` (n, h, w) of one exposure.

    ``shown``, of the shape of ``images``, has the fraction of each pixel in which a ring with its
    sticker is visible. ``corners`` (n, 2) are the first pixels of the windows.
    """
    height, width = images.shape[1:]
    for n in range(len(painted.boxes)):
        box = painted.boxes[n]
        for k in range(len(group)):
            corner = corners[k]
            if (
                box[2] >= corner[0]
                and box[3] >= corner[1]
                and box[0] <= corner[0] + width
                and box[1] <= corner[1] + height
            ):
                paint_window(images[group[k]], shown[group[k]], corner, n, painted)


@compiled
def scatter_objects(
    images: Array, behind: Array, group: Array, corners: Array, objects: Array, turn: Array,
    focal: Array, principal: Array,
) -> None:  # fmt: skip
    """Paint far objects into the windows ``images[group]`` (n, h, w) where no body hides them.

    ``behind``, of the shape of ``images``, has the fraction of each pixel that shows the
    background. Each of the ``objects`` (o, 5) has a direction in the base frame, an angular radius,
    rad, and a level above the background. ``turn`` (3, 3) is the rotation from base axes to camera
    axes. ``focal`` and ``principal`` (2,) are focal lengths and principal point, px.
    """
    height, width = images.shape[1:]
    ray = np.empty(3)
    for o in range(len(objects)):
        for i in range(3):
            ray[i] = 0.0
            for j in range(3):
                ray[i] += turn[i, j] * objects[o, j]
        if ray[2] <= 0.0:
            continue
        x = focal[0] * ray[0] / ray[2] + principal[0]
        y = focal[1] * ray[1] / ray[2] + principal[1]
        radius = objects[o, 3] * focal[0]
        for k in range(len(group)):
            left = x - corners[k, 0]
            top = y - corners[k, 1]
            image = images[group[k]]
            free = behind[group[k]]
            for row in range(max(0, int(top - radius - 1)), min(height, int(top + radius + 3))):
                for column in range(
                    max(0, int(left - radius - 1)), min(width, int(left + radius + 3))
                ):
                    away = math.sqrt((column - left) ** 2 + (row - top) ** 2)
                    share = min(max(0.5 + radius - away, 0.0), 1.0)
                    image[row, column] += share * free[row, column] * objects[o, 4]
