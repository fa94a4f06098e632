"""Compiled functions that find patches in windows, average drawn cells, and resample windows."""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled


@compiled
def boxes_reaching(
    pixels_from_bodies: Array,
    body_index: Array,
    boxes: Array,
    windows: Array,
    near: float,
    reaching: Array,
) -> None:
    """Fill ``reaching`` (n, patches) with whether each patch's box reaches into each window.

    ``pixels_from_bodies`` (b, 3, 4) are the projection matrices of the bodies. ``windows`` (n, 4)
    are lowest x, y and highest x, y, px. ``boxes`` (patches, 4, 8) are the corners of each box as
    columns (x, y, z in m, 1). A box with a depth of less than ``near`` m counts as reaching into
    all windows, unless it lies wholly behind the camera; then it reaches into none.
    """
    box = np.empty(4)
    point = np.empty(3)
    for p in range(len(boxes)):
        move = pixels_from_bodies[body_index[p]]
        box[:2] = np.inf
        box[2:] = -np.inf
        nearest = np.inf
        farthest = -np.inf
        for c in range(8):
            for i in range(3):
                point[i] = (
                    move[i, 0] * boxes[p, 0, c]
                    + move[i, 1] * boxes[p, 1, c]
                    + move[i, 2] * boxes[p, 2, c]
                    + move[i, 3]
                )
            nearest = min(nearest, point[2])
            farthest = max(farthest, point[2])
            if point[2] > near:
                for i in range(2):
                    box[i] = min(box[i], point[i] / point[2])
                    box[2 + i] = max(box[2 + i], point[i] / point[2])
        for n in range(len(windows)):
            if nearest <= near:
                reaching[n, p] = farthest > 0.0
            else:
                reaching[n, p] = (
                    box[2] >= windows[n, 0]
                    and box[3] >= windows[n, 1]
                    and box[0] <= windows[n, 2]
                    and box[1] <= windows[n, 3]
                )


@compiled
def mean_of_cells(drawn: Array, columns: int, supersampling: int, windows: Array) -> None:
    """Fill windows (n, h, w) float32, 0 to 1, with means of ``supersampling``² drawn pixels.

    ``drawn`` contains a cell for each window, with pixels from 0 to 255. The cells are in reading
    order, with ``columns`` cells per row.
    """
    count, height, width = windows.shape
    share = np.float32(1.0 / (supersampling * supersampling))
    white = np.float32(255.0)
    # Integer sums of 8-bit pixels are exact.
    sums = np.empty(width * supersampling, dtype=np.uint32)
    for n in range(count):
        top = n // columns * height * supersampling
        left = n % columns * width * supersampling
        for y in range(height):
            sums[:] = 0
            for i in range(supersampling):
                row = drawn[top + y * supersampling + i, left : left + width * supersampling]
                for x in range(len(row)):
                    sums[x] += row[x]
            for x in range(width):
                total = np.uint32(0)
                for i in range(supersampling):
                    total += sums[x * supersampling + i]
                windows[n, y, x] = np.float32(total) * share / white


@compiled
def keys_weights(share: float) -> tuple:
    """Return Keys' weights of four pixels in a row, for a position between the middle two.

    The position lies ``share`` px after the second pixel. A ``share`` outside of 0 to 1 is clamped.
    """
    s = min(max(share, 0.0), 1.0)
    return (
        s * (-0.5 + s * (1.0 - 0.5 * s)),
        1.0 + s * s * (-2.5 + 1.5 * s),
        s * (0.5 + s * (2.0 - 1.5 * s)),
        s * s * (-0.5 + 0.5 * s),
    )


@compiled
def mark_plain(drawn: Array, along: Array, plain: Array) -> None:
    """Mark in ``plain`` (h, w) the pixels of a drawn window (h, w) that equal all their neighbours.

    The neighbours are the pixels from one before to two after in both directions. At the edges,
    where some of them are missing, ``plain`` is not filled. ``along`` (h, w) is working memory.
    """
    height, width = drawn.shape
    for y in range(height):
        row = drawn[y]
        for x in range(1, width - 2):
            along[y, x] = (row[x - 1] == row[x]) & (row[x] == row[x + 1]) & (row[x] == row[x + 2])
    for y in range(1, height - 2):
        above = drawn[y - 1]
        row = drawn[y]
        below = drawn[y + 1]
        second_below = drawn[y + 2]
        for x in range(1, width - 2):
            even = along[y - 1, x] & along[y, x] & along[y + 1, x] & along[y + 2, x]
            plain[y, x] = (
                even & (above[x] == row[x]) & (row[x] == below[x]) & (row[x] == second_below[x])
            )


@compiled
def resample_windows(drawn: Array, coefficients: Array, result: Array) -> None:
    """Fill ``result`` (n, size, size) with windows resampled from drawn windows (n, h, w).

    Each pixel's position (x, y) in the drawn window is a biquadratic function of t and s, with the
    ``coefficients`` (n, 3, 3, 2) of t^a s^b. The row is expressed by t, which is -1 in the first
    row and 1 in the last, and the column by s alike. ``size`` must be at least 2. A position too
    near to the edge of the drawn window, or beyond, is clamped as ``interpolated`` says.
    """
    n, height, width = drawn.shape
    size = result.shape[1]
    along_row = np.empty((3, 2))
    along = np.empty((height, width), np.bool_)
    plain = np.empty((height, width), np.bool_)
    for k in range(n):
        mark_plain(drawn[k], along, plain)
        for row in range(size):
            # The nodes of the quadratic are at -1, 0 and 1.
            t = 2.0 * row / (size - 1) - 1.0
            for b in range(3):
                for axis in range(2):
                    along_row[b, axis] = (
                        coefficients[k, 0, b, axis]
                        + t * coefficients[k, 1, b, axis]
                        + t * t * coefficients[k, 2, b, axis]
                    )
            for column in range(size):
                s = 2.0 * column / (size - 1) - 1.0
                x = along_row[0, 0] + s * (along_row[1, 0] + s * along_row[2, 0])
                y = along_row[0, 1] + s * (along_row[1, 1] + s * along_row[2, 1])
                first_x = min(max(int(np.floor(x)), 1), width - 3)
                first_y = min(max(int(np.floor(y)), 1), height - 3)
                # The weights add up to one, so equal pixels need no interpolation.
                if plain[first_y, first_x]:
                    result[k, row, column] = drawn[k, first_y, first_x]
                else:
                    result[k, row, column] = interpolated(drawn[k], x, y, first_x, first_y)


@compiled
def interpolated(drawn: Array, x: float, y: float, first_x: int, first_y: int) -> float:
    """Return the value of a drawn window (h, w) at a position (x, y) between pixels.

    In each direction, four pixels are used, from one before ``first_x`` or ``first_y`` to two after
    it. A position that is not between the second and the third of them is clamped.
    """
    weights_x = keys_weights(x - first_x)
    weights_y = keys_weights(y - first_y)
    value = 0.0
    for i in range(4):
        line = 0.0
        for j in range(4):
            line += weights_x[j] * drawn[first_y - 1 + i, first_x - 1 + j]
        value += weights_y[i] * line
    return value
