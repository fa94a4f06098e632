"""Compiled functions that paint stickers and a bright background into drawn windows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled


class Paint(NamedTuple):
    """Stickers with their print, in the axes of their bodies, and the lamps that shine on them.

    bodies        (n,), body of each sticker
    places        (n, 3), m
    normals       (n, 3)
    axes          (n, 3, 2), axes u and v of each sticker's plane
    radius        of the stickers, m
    ring_radius   of the rings, m
    face, ring    levels of stickers and of their rings
    rim           level of the rims
    thickness     of the stickers, radii
    retro_shift   at an angle of view of 40 degrees, radii
    retro_angle   these 40 degrees, rad
    prints        (n, 5), coefficients of the modes of brightness
    outlines      (n, 8), coefficients of the harmonics 2 to 5 of the outline
    fall_off      power of the cosine of the angle of view
    ambient       light without lamps; 1 if there are no lamps
    lamps         (l, 4), place in the base frame, m, and 1, or direction and 0
    strengths     (l,), of the lamps
    distances     (l,), from the lamps to the place at which they have their strength, m
    """

    bodies: Array
    places: Array
    normals: Array
    axes: Array
    radius: float
    ring_radius: float
    face: float
    ring: float
    rim: float
    thickness: float
    retro_shift: float
    retro_angle: float
    prints: Array
    outlines: Array
    fall_off: float
    ambient: float
    lamps: Array
    strengths: Array
    distances: Array


@compiled
def light_at(paint: Paint, camera_from_base: Array, point: Array, normal: Array) -> float:
    """Return the light on a face at ``point`` (3,) with ``normal`` (3,), in camera axes.

    It is 1 for a face that has its stated level.
    """
    light = paint.ambient
    for k in range(len(paint.strengths)):
        far = paint.lamps[k, 3] == 0.0
        cosine = 0.0
        squared = 0.0
        for i in range(3):
            towards = 0.0 if far else -point[i]
            for j in range(4):
                towards += camera_from_base[i, j] * paint.lamps[k, j]
            cosine += towards * normal[i]
            squared += towards * towards
        cosine /= math.sqrt(squared)
        reach = 1.0 if far else paint.distances[k] ** 2 / squared
        light += paint.strengths[k] * max(cosine, 0.0) * reach
    return light


@compiled
def print_at(prints: Array, u: float, v: float) -> float:
    """Return the relative brightness at a place (u, v), which is moved into the unit disc."""
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
    """Return the share of a pixel at (u, v) that a disc of a radius covers.

    ``to_places`` (2, 2) is the derivative d(u, v) / d(pixels).
    """
    size = math.sqrt(u * u + v * v)
    if size < 1e-6:
        return 1.0
    x = (to_places[0, 0] * u + to_places[1, 0] * v) / size
    y = (to_places[0, 1] * u + to_places[1, 1] * v) / size
    return min(max(0.5 - (size - radius) / math.sqrt(x * x + y * y), 0.0), 1.0)


@compiled
def paint_window(
    image: Array, shown: Array, corner: Array, n: int, paint: Paint, to_sticker: Array,
    to_places: Array, box: Array, slope: Array, light: Array, face: float,
) -> None:  # fmt: skip
    """Paint sticker ``n`` into a window (h, w), where ``shown`` (h, w) states that it is visible.

    ``to_sticker`` (3, 3) maps pixels to (u, v, 1), and ``to_places`` (2, 2) is its derivative.
    ``box`` (4,) holds the ring. ``slope`` (4,) is the movement of lower points and the shift of
    the sticker, both in (u, v). ``light`` (3,) is the light at the centre and its slopes.
    """
    height, width = image.shape
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
            u -= slope[2]
            v -= slope[3]
            level = paint.ring
            if u * u + v * v < 4.0:
                own = covered(u, v, outline_at(paint.outlines[n], u, v), to_places)
                level += own * (face * max(print_at(paint.prints[n], u, v), 0.0) - paint.ring)
                if squared > 0.0 and own < 1.0:
                    # The depth of the rim that this pixel sees best, from 0 to the thickness.
                    depth = (u * slope[0] + v * slope[1]) / squared
                    depth = min(max(depth, 0.0), 1.0)
                    low_u = u - depth * slope[0]
                    low_v = v - depth * slope[1]
                    radius = outline_at(paint.outlines[n], low_u, low_v)
                    aside = max(covered(low_u, low_v, radius, to_places) - own, 0.0)
                    level += aside * (paint.rim - paint.ring)
            image[row, column] += share * (lit * level - paint.ring)


@compiled
def paint_view(
    images: Array, shown: Array, group: Array, corners: Array, paint: Paint,
    camera_from_bodies: Array, focal: Array, principal: Array, near: float,
) -> None:  # fmt: skip
    """Paint all stickers into the windows ``images[group]`` (n, h, w) of one exposure.

    ``shown`` (all, h, w) are the shares of pixels in which rings with their stickers are visible,
    and ``corners`` (n, 2) the first pixels of the windows.
    """
    height, width = images.shape[1:]
    to_image = np.empty((3, 3))
    slope = np.empty(4)
    light = np.empty(3)
    box = np.empty(4)
    for n in range(len(paint.bodies)):
        move = camera_from_bodies[paint.bodies[n]]
        turn = np.ascontiguousarray(move[:3, :3])
        centre = turn @ paint.places[n] + move[:3, 3]
        normal = turn @ paint.normals[n]
        axes = turn @ paint.axes[n]
        facing = centre @ normal
        if facing >= 0.0 or centre[2] - paint.ring_radius <= near:
            continue
        # The rays of a disc's points, in px and with a depth of their own.
        for k in range(3):
            ray = centre if k == 2 else paint.radius * axes[:, k]
            to_image[0, k] = focal[0] * ray[0] + principal[0] * ray[2]
            to_image[1, k] = focal[1] * ray[1] + principal[1] * ray[2]
            to_image[2, k] = ray[2]
        middle = to_image[:2, 2] / centre[2]
        near_ring = centre[2] - paint.ring_radius
        for i in range(2):
            reach = (
                focal[i]
                * paint.ring_radius
                / near_ring
                * (1.0 + abs(middle[i] - principal[i]) / focal[i])
            )
            box[i] = middle[i] - reach - 1.0
            box[2 + i] = middle[i] + reach + 1.0
        derivative = np.empty((2, 2))
        for i in range(2):
            for k in range(2):
                derivative[i, k] = (to_image[i, k] - middle[i] * to_image[2, k]) / centre[2]
        across = axes.T @ centre / facing
        size = math.sqrt(across[0] ** 2 + across[1] ** 2)
        retro = 0.0
        if size > 0.0:
            retro = -paint.retro_shift * math.atan(size) / paint.retro_angle / size
        for i in range(2):
            slope[i] = paint.thickness * across[i]
            slope[2 + i] = retro * across[i]
        light[0] = light_at(paint, camera_from_bodies[1], centre, normal)
        for i in range(2):
            step = paint.radius * axes[:, i]
            light[1 + i] = 0.5 * (
                light_at(paint, camera_from_bodies[1], centre + step, normal)
                - light_at(paint, camera_from_bodies[1], centre - step, normal)
            )
        cosine = -facing / math.sqrt(centre @ centre)
        face = paint.face * cosine**paint.fall_off
        to_sticker = np.linalg.inv(to_image)
        to_places = np.linalg.inv(derivative)
        for k in range(len(group)):
            corner = corners[k]
            if (
                box[2] >= corner[0]
                and box[3] >= corner[1]
                and box[0] <= corner[0] + width
                and box[1] <= corner[1] + height
            ):
                paint_window(
                    images[group[k]], shown[group[k]], corner, n, paint, to_sticker, to_places,
                    box, slope, light, face,
                )  # fmt: skip


@compiled
def scatter_objects(
    images: Array, behind: Array, group: Array, corners: Array, objects: Array, turn: Array,
    focal: Array, principal: Array,
) -> None:  # fmt: skip
    """Paint far objects into the windows ``images[group]`` (n, h, w) where nothing is before them.

    ``behind`` (all, h, w) are the shares of pixels that show the background. ``objects`` (o, 5) are
    a direction in the base frame, an angular radius, rad, and the level above the background.
    ``turn`` (3, 3) leads from base axes to camera axes.
    """
    height, width = images.shape[1:]
    for o in range(len(objects)):
        ray = turn @ objects[o, :3]
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
