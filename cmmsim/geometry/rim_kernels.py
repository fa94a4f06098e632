"""Compiled: how much of each pixel an ellipse covers, arc by arc of its rim; the formulas stand in ``disc_image``.

The rim is followed once around, from one line between pixels to the next. An ellipse comes as its centre and the matrix
A (2,2) that carries the unit circle onto it; pixel (row, column) reaches half a pixel to all sides of its middle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compiled import Array, compiled

SHORT_ARC = 0.2  # tangent of half an arc's angle, up to which eleven terms of its series give all digits


class Cover(NamedTuple):
    """What arcs leave in a window: shares (h, w), area from the left side of their own pixels; past (h, w + 1), how far
    they rise, which covers all pixels left of them; touched (h, w), whether there are any; derivatives (h, w, 5) of the
    shares by [c_x, c_y, A_xx, A_xy, A_yy], or none (0, 0, 5)."""

    shares: Array
    past: Array
    touched: Array
    derivatives: Array


@compiled
def angle_between(cross: float, dot: float) -> float:
    """Angle from one unit vector to another, by their cross and dot products."""
    half = cross / (1.0 + dot)  # its tangent
    if not abs(half) < SHORT_ARC:
        return math.atan2(cross, dot)
    z = half * half
    w = z * z
    even = 1.0 + w * (1.0 / 5.0 + w * (1.0 / 9.0 + w * (1.0 / 13.0 + w * (1.0 / 17.0 + w / 21.0))))
    odd = 1.0 / 3.0 + w * (1.0 / 7.0 + w * (1.0 / 11.0 + w * (1.0 / 15.0 + w / 19.0)))
    return 2.0 * half * (even - z * odd)


@compiled
def add_arc(
    row: int, column: int, u_0: float, v_0: float, u_1: float, v_1: float, centre_x: float, shape: Array, cover: Cover
) -> None:
    """Add what the arc from (u_0, v_0) to (u_1, v_1) of the unit circle, carried into one pixel, does to the window."""
    height, width = cover.shares.shape
    if row < 0 or row >= height or column < 0:
        return
    a, b, c, d = shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1]
    rise = c * (u_1 - u_0) + d * (v_1 - v_0)
    cover.past[row, min(column, width)] += rise
    if column >= width:
        return
    cover.touched[row, column] = True
    angle, gain = angle_between(u_0 * v_1 - u_1 * v_0, u_0 * u_1 + v_0 * v_1), u_1 * v_1 - u_0 * v_0
    u_by_u, v_by_v = 0.5 * (u_1 - u_0) * (u_1 + u_0), 0.5 * (v_1 - v_0) * (v_1 + v_0)  # integrals of u du, v dv
    u_by_v, v_by_u = 0.5 * (gain + angle), 0.5 * (gain - angle)
    u_by_y, v_by_y = c * u_by_u + d * u_by_v, c * v_by_u + d * v_by_v
    cover.shares[row, column] += (centre_x - column + 0.5) * rise + a * u_by_y + b * v_by_y
    if len(cover.derivatives):
        into = cover.derivatives[row, column]
        into[0] += rise
        into[1] -= a * (u_1 - u_0) + b * (v_1 - v_0)
        into[2] += u_by_y
        into[3] += v_by_y - a * u_by_u - b * u_by_v
        into[4] -= a * v_by_u + b * v_by_v


@compiled
def follow_quarter(
    quarter: int, start: tuple, end: tuple, level: tuple, steep: tuple, centre: tuple, shape: Array, cover: Cover
) -> None:
    """Follow the rim from ``start`` to ``end``, (u, v) of the unit circle, between which x and y only rise or fall.

    quarter: 0 from the largest x to the largest y, and so on; ``level`` and ``steep``: (u, v, reach px) where x and y
    are largest.
    """
    a, b, c, d = shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1]
    (u, v), (last_u, last_v), (x_u, x_v, reach_x), (y_u, y_v, reach_y) = start, end, level, steep
    centre_x, centre_y = centre
    way_x, way_y = 1 if quarter >= 2 else -1, 1 if quarter == 0 or quarter == 3 else -1
    x, y = centre_x + a * u + b * v, centre_y + c * u + d * v
    end_x, end_y = centre_x + a * last_u + b * last_v, centre_y + c * last_u + d * last_v
    height, width = cover.shares.shape
    if max(y, end_y) < -0.5 or min(y, end_y) > height - 0.5 or max(x, end_x) < -0.5:
        return
    column, row = math.floor(x + 0.5), math.floor(y + 0.5)
    across_u, across_v, down_u, down_v, down_x = 0.0, 0.0, 0.0, 0.0, 0.0
    new_column, new_row = True, True
    while True:
        line_x, line_y = column + 0.5 * way_x, row + 0.5 * way_y
        crosses_x, crosses_y = (end_x - line_x) * way_x > 0.0, (end_y - line_y) * way_y > 0.0
        if new_column and crosses_x:
            t = (line_x - centre_x) / reach_x
            s = -way_x * math.sqrt(max(1.0 - t * t, 0.0))
            across_u, across_v = t * x_u - s * x_v, t * x_v + s * x_u
        if new_row and crosses_y:
            t = (line_y - centre_y) / reach_y
            s = -way_y * math.sqrt(max(1.0 - t * t, 0.0))
            down_u, down_v = t * y_u - s * y_v, t * y_v + s * y_u
            down_x = centre_x + a * down_u + b * down_v
        if crosses_x and (not crosses_y or (down_x - line_x) * way_x >= 0.0):
            add_arc(row, column, u, v, across_u, across_v, centre_x, shape, cover)
            u, v, column, new_column, new_row = across_u, across_v, column + way_x, True, False
        elif crosses_y:
            add_arc(row, column, u, v, down_u, down_v, centre_x, shape, cover)
            u, v, row, new_column, new_row = down_u, down_v, row + way_y, False, True
        else:
            add_arc(row, column, u, v, last_u, last_v, centre_x, shape, cover)
            return


@compiled
def cover_by_ellipse(centre_x: float, centre_y: float, shape: Array, cover: Cover) -> None:
    """Fill a window with the covered shares, 0 or 1 exactly where the rim does not pass, and their derivatives."""
    for values in (cover.shares, cover.past):
        values[:] = 0.0
    cover.derivatives[:] = 0.0
    cover.touched[:] = False
    reach_x, reach_y = math.hypot(shape[0, 0], shape[0, 1]), math.hypot(shape[1, 0], shape[1, 1])
    x_u, x_v, y_u, y_v = shape[0, 0] / reach_x, shape[0, 1] / reach_x, shape[1, 0] / reach_y, shape[1, 1] / reach_y
    ends = (x_u, x_v), (y_u, y_v), (-x_u, -x_v), (-y_u, -y_v)
    for quarter in range(4):
        start, end = ends[quarter], ends[(quarter + 1) % 4]
        follow_quarter(
            quarter, start, end, (x_u, x_v, reach_x), (y_u, y_v, reach_y), (centre_x, centre_y), shape, cover
        )
    height, width = cover.shares.shape
    for row in range(height):
        risen = cover.past[row, width]
        for column in range(width - 1, -1, -1):
            cover.shares[row, column] += risen if cover.touched[row, column] else np.rint(risen)
            risen += cover.past[row, column]


@compiled
def empty_cover(height: int, width: int, derivatives: Array) -> Cover:
    """What ``cover_by_ellipse`` fills, with memory of its own but for the derivatives."""
    return Cover(
        np.empty((height, width)), np.empty((height, width + 1)), np.empty((height, width), np.bool_), derivatives
    )


@compiled
def cover_window(centre_x: float, centre_y: float, shape: Array, shares: Array, derivatives: Array) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5)."""
    height, width = shares.shape
    past, touched = np.empty((height, width + 1)), np.empty((height, width), np.bool_)
    cover_by_ellipse(centre_x, centre_y, shape, Cover(shares, past, touched, derivatives))


@compiled
def cover_windows(centres: Array, shapes: Array, shares: Array, derivatives: Array) -> None:
    """``cover_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        cover_window(centres[k, 0], centres[k, 1], shapes[k], shares[k], derivatives[k])
