"""Compiled kernels for the fraction of each pixel that an ellipse covers, arc by arc of its rim.

``disc_image`` states the formulas. The rim is followed once around, from one line between pixels to
the next. An ellipse is given by its centre and the matrix A (2, 2) that maps the unit circle onto
it. Pixel (row, column) extends half a pixel from its middle to each side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled

# Up to this tangent of half an arc's angle, eleven terms of the series give full precision.
SHORT_ARC = 0.2


class Cover(NamedTuple):
    """Contributions of arcs to the covered areas of a window.

    shares       (h, w), areas between the left side of a pixel and the arcs inside it
    past         (h, w + 1), total rise dy of the arcs in a pixel, which contributes to all pixels
                 to the left; column w is for the arcs to the right of the window
    touched      (h, w), True for pixels with arcs
    derivatives  (h, w, 5), of the shares with respect to [c_x, c_y, A_xx, A_xy, A_yy]; not computed
                 if the shape is (0, 0, 5)
    """

    shares: Array
    past: Array
    touched: Array
    derivatives: Array


class Arcs(NamedTuple):
    """Arcs in the order in which they follow each other on the rim.

    ``rows`` and ``columns`` (n,) are those of their pixels. ``ends`` (n, 4) are the start and the
    end of each arc as points u, v, u, v of the unit circle.
    """

    rows: Array
    columns: Array
    ends: Array


@compiled
def angle_between(cross: float, dot: float) -> float:
    """Return the signed angle between two unit vectors, rad, from their cross and dot products."""
    half = cross / (1.0 + dot)  # tangent of half the angle
    if not abs(half) < SHORT_ARC:
        return math.atan2(cross, dot)
    z = half * half
    w = z * z
    # Splitting the series of the arctangent in two allows the processor to compute both at once.
    even = 1.0 + w * (1.0 / 5.0 + w * (1.0 / 9.0 + w * (1.0 / 13.0 + w * (1.0 / 17.0 + w / 21.0))))
    odd = 1.0 / 3.0 + w * (1.0 / 7.0 + w * (1.0 / 11.0 + w * (1.0 / 15.0 + w / 19.0)))
    return 2.0 * half * (even - z * odd)


@compiled
def add_arcs(count: int, arcs: Arcs, centre_x: float, shape: Array, cover: Cover) -> None:
    """Add the contributions of the first ``count`` arcs to ``cover``."""
    width = cover.shares.shape[1]
    sloping = len(cover.derivatives) > 0
    a = shape[0, 0]
    b = shape[0, 1]
    c = shape[1, 0]
    d = shape[1, 1]
    for k in range(count):
        row = arcs.rows[k]
        column = arcs.columns[k]
        u_0, v_0, u_1, v_1 = arcs.ends[k]
        rise = c * (u_1 - u_0) + d * (v_1 - v_0)
        cover.past[row, column] += rise
        if column == width:
            continue
        cover.touched[row, column] = True
        angle = angle_between(u_0 * v_1 - u_1 * v_0, u_0 * u_1 + v_0 * v_1)
        gain = u_1 * v_1 - u_0 * v_0
        # Integrals of u du, v dv, u dv and v du along the arc.
        u_by_u = 0.5 * (u_1 - u_0) * (u_1 + u_0)
        v_by_v = 0.5 * (v_1 - v_0) * (v_1 + v_0)
        u_by_v = 0.5 * (gain + angle)
        v_by_u = 0.5 * (gain - angle)
        u_by_y = c * u_by_u + d * u_by_v
        v_by_y = c * v_by_u + d * v_by_v
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
    """Fill ``crossed`` (n, 2) for the n lines that bound n - 1 pixels along one axis.

    The first column is the signed distance of a line from the centre, in units of the half extent
    ``reach`` of the ellipse. The second is half the length of the chord that a line at this
    distance has inside the unit circle, or 0 for a line outside.
    """
    per_reach = 1.0 / reach
    for k in range(len(crossed)):
        t = (k - 0.5 - centre) * per_reach
        crossed[k, 0] = t
        crossed[k, 1] = math.sqrt(max(1.0 - t * t, 0.0))


@compiled
def follow_quarter(
    quarter: int,
    ends: tuple,
    centre: tuple,
    shape: Array,
    columns: Array,
    rows: Array,
    count: int,
    arcs: Arcs,
) -> int:
    """Follow a quarter of the rim, on which x and y are both monotonic; return the number of arcs.

    Quarter 0 leads from the largest x to the largest y, quarter 1 from there to the smallest x, and
    so on. ``ends`` are (u, v) of these four points. ``columns`` (w + 1, 2) and ``rows`` (h + 1, 2)
    are the ``crossings`` of the lines between pixels. ``arcs`` is filled from index ``count`` on,
    and the result is the number of all arcs, with those before. Arcs above, below and to the left
    of the window are omitted. Arcs to its right are assigned to column w.
    """
    x_u, x_v = ends[0]
    y_u, y_v = ends[1]
    u, v = ends[quarter]
    end_u, end_v = ends[(quarter + 1) % 4]
    centre_x, centre_y = centre
    a = shape[0, 0]
    b = shape[0, 1]
    c = shape[1, 0]
    d = shape[1, 1]
    way_x = 1 if quarter >= 2 else -1
    way_y = 1 if quarter == 0 or quarter == 3 else -1
    width = len(columns) - 1
    height = len(rows) - 1
    end_x = centre_x + a * end_u + b * end_v
    end_y = centre_y + c * end_u + d * end_v
    column = within(centre_x + a * u + b * v, width)
    row = within(centre_y + c * u + d * v, height)
    side = 1 if way_x > 0 else 0, 1 if way_y > 0 else 0
    down_u = 0.0
    down_v = 0.0
    down_x = 0.0
    new_row = True
    going = True
    while going and not (row == (height if way_y > 0 else -1) or (column < 0 and way_x < 0)):
        above = row < 0 or row == height
        line_x = column + 0.5 * way_x
        crosses_x = (
            not (above or (column == width and way_x > 0)) and (end_x - line_x) * way_x > 0.0
        )
        crosses_y = (end_y - row - 0.5 * way_y) * way_y > 0.0
        # The crossing with the next line between rows is computed once per row.
        if new_row and crosses_y:
            t = rows[row + side[1], 0]
            s = -way_y * rows[row + side[1], 1]
            down_u = t * y_u - s * y_v
            down_v = t * y_v + s * y_u
            down_x = centre_x + a * down_u + b * down_v
            new_row = False
        to_u = end_u
        to_v = end_v
        to_column = column
        to_row = row
        # The arc ends at whichever of the two lines the rim crosses first.
        if crosses_x and (not crosses_y or (down_x - line_x) * way_x >= 0.0):
            t = columns[column + side[0], 0]
            s = -way_x * columns[column + side[0], 1]
            to_u = t * x_u - s * x_v
            to_v = t * x_v + s * x_u
            to_column = column + way_x
        elif crosses_y:
            to_u = down_u
            to_v = down_v
            to_row = row + way_y
            new_row = True
            if above or column == width:
                to_column = within(down_x, width)
        else:
            going = False
        # Arcs left of the window cover none of its pixels.
        if not above and column >= 0:
            arcs.rows[count] = row
            arcs.columns[count] = column
            arcs.ends[count, 0] = u
            arcs.ends[count, 1] = v
            arcs.ends[count, 2] = to_u
            arcs.ends[count, 3] = to_v
            count += 1
        u = to_u
        v = to_v
        column = to_column
        row = to_row
    return count


@compiled
def within(place: float, size: int) -> int:
    """Return the row or column of a coordinate; -1 before the window, and ``size`` beyond it."""
    return math.floor(min(max(place + 0.5, -1.0), float(size)))


@compiled
def follow_rim(centre_x: float, centre_y: float, shape: Array, cover: Cover) -> None:
    """Fill ``cover`` from all arcs of the rim.

    The shares do not yet include the arcs to the right of each pixel, see ``cover_window``.
    """
    cover.shares[:] = 0.0
    cover.past[:] = 0.0
    cover.touched[:] = False
    cover.derivatives[:] = 0.0
    height, width = cover.shares.shape
    reach_x = math.hypot(shape[0, 0], shape[0, 1])
    reach_y = math.hypot(shape[1, 0], shape[1, 1])
    x_u = shape[0, 0] / reach_x
    x_v = shape[0, 1] / reach_x
    y_u = shape[1, 0] / reach_y
    y_v = shape[1, 1] / reach_y
    ends = (x_u, x_v), (y_u, y_v), (-x_u, -x_v), (-y_u, -y_v)
    columns = np.empty((width + 1, 2))
    rows = np.empty((height + 1, 2))
    # not a literal, for which Numba would compile what takes it once more
    count = int(np.int64(0))
    crossings(centre_x, reach_x, columns)
    crossings(centre_y, reach_y, rows)
    # Each line is crossed at most twice, and each of the four quarters ends with one arc more.
    most = 2 * (width + height) + 12
    arcs = Arcs(np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, 4)))
    for quarter in range(4):
        count = follow_quarter(
            quarter, ends, (centre_x, centre_y), shape, columns, rows, count, arcs
        )
    add_arcs(count, arcs, centre_x, shape, cover)


@compiled
def cover_window(
    centre_x: float, centre_y: float, shape: Array, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (h, w), the fractions of pixels that an ellipse covers, and ``derivatives``.

    The derivatives are those of ``Cover``. The share of a pixel that the rim does not cross is
    exactly 0 or 1.
    """
    height, width = shares.shape
    cover = Cover(
        shares, np.empty((height, width + 1)), np.empty((height, width), np.bool_), derivatives
    )
    follow_rim(centre_x, centre_y, shape, cover)
    reach = math.hypot(shape[1, 0], shape[1, 1])
    first = max(within(centre_y - reach, height), 0)
    last = min(within(centre_y + reach, height), height - 1)
    for row in range(first, last + 1):
        # add the rise of all arcs farther right; for pixels without arcs, it is exactly 0 or 1
        risen = cover.past[row, width]
        filled = np.rint(risen)
        for column in range(width - 1, -1, -1):
            if cover.touched[row, column]:
                shares[row, column] += risen
                risen += cover.past[row, column]
                filled = np.rint(risen)
            else:
                shares[row, column] = filled


@compiled
def cover_windows(centres: Array, shapes: Array, shares: Array, derivatives: Array) -> None:
    """Fill ``shares`` (n, h, w) and ``derivatives`` (n, h, w, 5), see ``cover_window``."""
    for k in range(len(centres)):
        cover_window(centres[k, 0], centres[k, 1], shapes[k], shares[k], derivatives[k])
