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


class Arcs(NamedTuple):
    """Arcs in the order of the rim: rows and columns (n,) of their pixels, and starts and ends (n,4) as u, v, u, v."""

    rows: Array
    columns: Array
    ends: Array


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
def add_arcs(count: int, arcs: Arcs, centre_x: float, shape: Array, cover: Cover) -> None:
    """Add what ``count`` arcs do to a window."""
    width, sloping = cover.shares.shape[1], len(cover.derivatives) > 0
    a, b, c, d = shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1]
    for k in range(count):
        row, column, (u_0, v_0, u_1, v_1) = arcs.rows[k], arcs.columns[k], arcs.ends[k]
        rise = c * (u_1 - u_0) + d * (v_1 - v_0)
        cover.past[row, column] += rise
        if column == width:
            continue
        cover.touched[row, column] = True
        angle, gain = angle_between(u_0 * v_1 - u_1 * v_0, u_0 * u_1 + v_0 * v_1), u_1 * v_1 - u_0 * v_0
        u_by_u, v_by_v = 0.5 * (u_1 - u_0) * (u_1 + u_0), 0.5 * (v_1 - v_0) * (v_1 + v_0)  # integrals of u du, v dv
        u_by_v, v_by_u = 0.5 * (gain + angle), 0.5 * (gain - angle)
        u_by_y, v_by_y = c * u_by_u + d * u_by_v, c * v_by_u + d * v_by_v
        cover.shares[row, column] += (centre_x - column + 0.5) * rise + a * u_by_y + b * v_by_y
        if sloping:
            into = cover.derivatives[row, column]
            into[0] += rise
            into[1] -= a * (u_1 - u_0) + b * (v_1 - v_0)
            into[2] += u_by_y
            into[3] += v_by_y - a * u_by_u - b * u_by_v
            into[4] -= a * v_by_u + b * v_by_v


@compiled
def crossings(centre: float, reach: float, crossed: Array) -> None:
    """Fill ``crossed`` (n,2) for the lines before, between and behind n - 1 pixels: how far they lie from the centre,
    in units of the ``reach`` of the rim, and half their length in the unit circle."""
    share = 1.0 / reach
    for k in range(len(crossed)):
        t = (k - 0.5 - centre) * share
        crossed[k, 0], crossed[k, 1] = t, math.sqrt(max(1.0 - t * t, 0.0))


@compiled
def follow_quarter(
    quarter: int, ends: tuple, centre: tuple, shape: Array, columns: Array, rows: Array, count: int, arcs: Arcs
) -> int:
    """Follow a part of the rim on which x and y only rise or fall; returns the number of arcs with those found before.

    quarter: 0 from the largest x to the largest y, and so on; ends: (u, v) of these four; columns (w + 1, 2) and rows
    (h + 1, 2): ``crossings`` of the lines between pixels. Arcs above, below and left of the window are left out, those
    right of it stand in the column behind the last.
    """
    (x_u, x_v), (y_u, y_v) = ends[0], ends[1]
    (u, v), (last_u, last_v) = ends[quarter], ends[(quarter + 1) % 4]
    (centre_x, centre_y), (a, b, c, d) = centre, (shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1])
    way_x, way_y = 1 if quarter >= 2 else -1, 1 if quarter == 0 or quarter == 3 else -1
    width, height = len(columns) - 1, len(rows) - 1
    end_x, end_y = centre_x + a * last_u + b * last_v, centre_y + c * last_u + d * last_v
    column, row = within(centre_x + a * u + b * v, width), within(centre_y + c * u + d * v, height)
    side = 1 if way_x > 0 else 0, 1 if way_y > 0 else 0
    down_u, down_v, down_x, new_row, left = 0.0, 0.0, 0.0, True, True
    while left and not (row == (height if way_y > 0 else -1) or (column < 0 and way_x < 0)):
        above = row < 0 or row == height
        line_x = column + 0.5 * way_x
        crosses_x = not (above or (column == width and way_x > 0)) and (end_x - line_x) * way_x > 0.0
        crosses_y = (end_y - row - 0.5 * way_y) * way_y > 0.0
        if new_row and crosses_y:
            t, s = rows[row + side[1], 0], -way_y * rows[row + side[1], 1]
            down_u, down_v = t * y_u - s * y_v, t * y_v + s * y_u
            down_x, new_row = centre_x + a * down_u + b * down_v, False
        to_u, to_v, to_column, to_row = last_u, last_v, column, row
        if crosses_x and (not crosses_y or (down_x - line_x) * way_x >= 0.0):
            t, s = columns[column + side[0], 0], -way_x * columns[column + side[0], 1]
            to_u, to_v, to_column = t * x_u - s * x_v, t * x_v + s * x_u, column + way_x
        elif crosses_y:
            to_u, to_v, to_row, new_row = down_u, down_v, row + way_y, True
            if above or column == width:
                to_column = within(down_x, width)
        else:
            left = False
        if not above and column >= 0:
            arcs.rows[count], arcs.columns[count] = row, column
            arcs.ends[count, 0], arcs.ends[count, 1], arcs.ends[count, 2], arcs.ends[count, 3] = u, v, to_u, to_v
            count += 1
        u, v, column, row = to_u, to_v, to_column, to_row
    return count


@compiled
def within(place: float, size: int) -> int:
    """The row or column of a place in a window; -1 before it, and ``size`` behind."""
    return math.floor(min(max(place + 0.5, -1.0), float(size)))


@compiled
def follow_rim(centre_x: float, centre_y: float, shape: Array, cover: Cover) -> None:
    """Fill ``cover`` but for what the pixels get from arcs right of them."""
    cover.shares[:] = 0.0
    cover.past[:] = 0.0
    cover.touched[:] = False
    cover.derivatives[:] = 0.0
    height, width = cover.shares.shape
    reach_x, reach_y = math.hypot(shape[0, 0], shape[0, 1]), math.hypot(shape[1, 0], shape[1, 1])
    x_u, x_v, y_u, y_v = shape[0, 0] / reach_x, shape[0, 1] / reach_x, shape[1, 0] / reach_y, shape[1, 1] / reach_y
    ends = (x_u, x_v), (y_u, y_v), (-x_u, -x_v), (-y_u, -y_v)
    columns, rows, count = np.empty((width + 1, 2)), np.empty((height + 1, 2)), 0
    crossings(centre_x, reach_x, columns)
    crossings(centre_y, reach_y, rows)
    most = 2 * (width + height) + 12  # each line is crossed twice, and each quarter ends once
    arcs = Arcs(np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, 4)))
    for quarter in range(4):
        count = follow_quarter(quarter, ends, (centre_x, centre_y), shape, columns, rows, count, arcs)
    add_arcs(count, arcs, centre_x, shape, cover)


@compiled
def cover_window(centre_x: float, centre_y: float, shape: Array, shares: Array, derivatives: Array) -> None:
    """Fill ``shares`` (h, w), 0 or 1 exactly where the rim does not pass, and ``derivatives`` (h, w, 5)."""
    height, width = shares.shape
    cover = Cover(shares, np.empty((height, width + 1)), np.empty((height, width), np.bool_), derivatives)
    follow_rim(centre_x, centre_y, shape, cover)
    reach = math.hypot(shape[1, 0], shape[1, 1])
    first, last = max(within(centre_y - reach, height), 0), min(within(centre_y + reach, height), height - 1)
    for row in range(first, last + 1):
        risen = cover.past[row, width]
        whole = np.rint(risen)
        for column in range(width - 1, -1, -1):
            if cover.touched[row, column]:
                shares[row, column] += risen
                risen += cover.past[row, column]
                whole = np.rint(risen)
            else:
                shares[row, column] = whole


@compiled
def cover_windows(centres: Array, shapes: Array, shares: Array, derivatives: Array) -> None:
    """``cover_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        cover_window(centres[k, 0], centres[k, 1], shapes[k], shares[k], derivatives[k])
