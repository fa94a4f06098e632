"""Compiled: exact share of pixels that an ellipse covers, see ``ellipse_coverage`` for the formulas.

An ellipse comes as its centre and the matrix m = A^-1 (2,2) that carries px into the axes of the unit disc.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import compiled


@compiled
def inside_part(start2: float, dot: float, step2: float) -> tuple[float, float]:
    """Where the side start + t step, t in [0, 1], enters and leaves the unit disc (equal when it stays outside).

    Given |start|², start . step and |step|².
    """
    discriminant = dot * dot - step2 * (start2 - 1.0)
    root = math.sqrt(max(discriminant, 0.0))
    enter = min(max((-dot - root) / step2, 0.0), 1.0)
    leave = min(max((-dot + root) / step2, 0.0), 1.0)
    return enter, leave


@compiled
def side_share(start_x: float, start_y: float, step_x: float, step_y: float) -> tuple[float, float, float]:
    """Twice the signed area, in disc units, between the disc's centre and one side: its part inside gives a triangle,
    the parts outside give sectors. Also where the side enters and leaves the disc."""
    start2 = start_x * start_x + start_y * start_y
    step2 = step_x * step_x + step_y * step_y
    dot = start_x * step_x + start_y * step_y
    cross = start_x * step_y - start_y * step_x
    enter, leave = inside_part(start2, dot, step2)
    if enter == leave:  # outside: one sector
        return math.atan2(cross, start2 + dot), enter, leave
    area = (leave - enter) * cross
    if enter > 0.0:
        area += math.atan2(enter * cross, start2 + enter * dot)
    if leave < 1.0:
        area += math.atan2((1.0 - leave) * cross, start2 + (1.0 + leave) * dot + leave * step2)
    return area, enter, leave


@compiled
def reach_of_pixel(m: np.ndarray) -> float:
    """Largest distance, in disc units, of a pixel's points from its middle."""
    return 0.5 * math.sqrt(
        max((m[0, 0] + m[0, 1]) ** 2 + (m[1, 0] + m[1, 1]) ** 2, (m[0, 0] - m[0, 1]) ** 2 + (m[1, 0] - m[1, 1]) ** 2)
    )


@compiled
def cover_pixel(x: float, y: float, m: np.ndarray) -> tuple[float, float, float, float, float, float]:
    """Share of the pixel with middle (x, y), px from the ellipse's centre, and its derivatives by [c_x, c_y, A_xx,
    A_xy, A_yy]: along each side the boundary moves by v = dc + dA A^-1 (x - c)."""
    det = 1.0 / (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0])
    left, right, low, high = x - 0.5, x + 0.5, y - 0.5, y + 0.5
    a_x, a_y = m[0, 0] * left + m[0, 1] * low, m[1, 0] * left + m[1, 1] * low  # the corner (left, low)
    b_x, b_y = a_x + m[0, 0], a_y + m[1, 0]  # (right, low)
    d_x, d_y = a_x + m[0, 1], a_y + m[1, 1]  # (left, high)
    area_low, low_in, low_out = side_share(a_x, a_y, m[0, 0], m[1, 0])
    area_high, high_in, high_out = side_share(d_x, d_y, m[0, 0], m[1, 0])
    area_left, left_in, left_out = side_share(a_x, a_y, m[0, 1], m[1, 1])
    area_right, right_in, right_out = side_share(b_x, b_y, m[0, 1], m[1, 1])
    share = 0.5 * det * (area_low - area_high + area_right - area_left)

    in_low, in_high, in_left, in_right = low_out - low_in, high_out - high_in, left_out - left_in, right_out - right_in
    mid_low, mid_high = left + 0.5 * (low_in + low_out), left + 0.5 * (high_in + high_out)
    mid_left, mid_right = low + 0.5 * (left_in + left_out), low + 0.5 * (right_in + right_out)
    # flux through the sides of m (x - c), row by row: up through those along x, rightwards through those along y
    up_0 = in_high * (m[0, 0] * mid_high + m[0, 1] * high) - in_low * (m[0, 0] * mid_low + m[0, 1] * low)
    up_1 = in_high * (m[1, 0] * mid_high + m[1, 1] * high) - in_low * (m[1, 0] * mid_low + m[1, 1] * low)
    across_0 = in_right * (m[0, 0] * right + m[0, 1] * mid_right) - in_left * (m[0, 0] * left + m[0, 1] * mid_left)
    across_1 = in_right * (m[1, 0] * right + m[1, 1] * mid_right) - in_left * (m[1, 0] * left + m[1, 1] * mid_left)
    by_xx = m[0, 0] * share - across_0
    by_xy = (m[0, 1] + m[1, 0]) * share - across_1 - up_0
    by_yy = m[1, 1] * share - up_1
    return share, in_left - in_right, in_low - in_high, by_xx, by_xy, by_yy


@compiled
def inverse_of(shape: np.ndarray) -> np.ndarray:
    """Inverse (2,2) of a (2,2) matrix."""
    det = shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0]
    m = np.empty((2, 2))
    m[0, 0], m[0, 1], m[1, 0], m[1, 1] = shape[1, 1] / det, -shape[0, 1] / det, -shape[1, 0] / det, shape[0, 0] / det
    return m


@compiled
def cover_window(
    centre_x: float, centre_y: float, shape: np.ndarray, shares: np.ndarray, derivatives: np.ndarray
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5); only pixels on the rim need more than a distance."""
    m = inverse_of(shape)
    reach = reach_of_pixel(m)
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            x, y = column - centre_x, row - centre_y
            distance = math.sqrt((m[0, 0] * x + m[0, 1] * y) ** 2 + (m[1, 0] * x + m[1, 1] * y) ** 2)
            if abs(distance - 1.0) < reach:
                share, by_x, by_y, by_xx, by_xy, by_yy = cover_pixel(x, y, m)
                shares[row, column] = share
                into = derivatives[row, column]
                into[0], into[1], into[2], into[3], into[4] = by_x, by_y, by_xx, by_xy, by_yy
            else:
                shares[row, column] = 1.0 if distance < 1.0 else 0.0
                derivatives[row, column] = 0.0


@compiled
def cover_windows(centres: np.ndarray, shapes: np.ndarray, shares: np.ndarray, derivatives: np.ndarray) -> None:
    """``cover_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        cover_window(centres[k, 0], centres[k, 1], shapes[k], shares[k], derivatives[k])
