"""Compiled: discs as a camera sees them, and their light in each pixel, sharp and blurred.

The formulas stand in ``disc_image``. An ellipse comes as its centre and the matrix m = A^-1 (2,2) that carries px into
the axes of the unit disc.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import Array, compiled


@compiled
def project_all(
    centres: Array, normals: Array, radii: Array, focal: Array, principal: Array, middles: Array, shapes: Array
) -> None:
    """Ellipses of n discs with centres (n,3), normals (n,3) and radii (n,): ``middles`` (n,2) px and ``shapes`` (n,2,2)
    px, the root of a matrix M: (M + d I) / sqrt(trace M + 2 d), d² = det M."""
    at = np.empty(2)
    for n in range(len(centres)):
        centre, normal, radius, middle, shape = centres[n], normals[n], radii[n], middles[n], shapes[n]
        depth = centre[2] ** 2 - radius**2 * (1.0 - normal[2] ** 2)
        for i in range(2):
            at[i] = (centre[i] * centre[2] + radius**2 * normal[i] * normal[2]) / depth
            middle[i] = focal[i] * at[i] + principal[i]
        for i in range(2):
            for j in range(2):
                across = 1.0 if i == j else 0.0
                dual = (centre[i] * centre[j] - radius**2 * (across - normal[i] * normal[j])) / depth
                shape[i, j] = focal[i] * focal[j] * (at[i] * at[j] - dual)
        d = math.sqrt(shape[0, 0] * shape[1, 1] - shape[0, 1] ** 2)
        scale = math.sqrt(shape[0, 0] + shape[1, 1] + 2.0 * d)
        shape[0, 0] += d
        shape[1, 1] += d
        for i in range(2):
            for j in range(2):
                shape[i, j] /= scale


@compiled
def place_discs(moves: Array, owners: Array, places: Array, directions: Array, centres: Array, normals: Array) -> None:
    """Centres and normals (n,3) in camera axes of discs at ``places`` with normals ``directions`` (n,3) in the axes of
    their ``owners`` (n,); moves (b,4,4) camera from bodies."""
    for n in range(len(places)):
        move = moves[owners[n]]
        for i in range(3):
            centres[n, i], normals[n, i] = move[i, 3], 0.0
            for j in range(3):
                centres[n, i] += move[i, j] * places[n, j]
                normals[n, i] += move[i, j] * directions[n, j]


@compiled
def probe_discs(centres: Array, normals: Array, radii: Array, probes: Array) -> None:
    """Fill probes (n,k,3): the middle of each disc, then k - 1 points on its rim."""
    count = probes.shape[1] - 1
    u = np.empty(3)
    for n in range(len(centres)):
        normal = normals[n]
        least = 0
        for i in range(1, 3):
            if abs(normal[i]) < abs(normal[least]):
                least = i
        length = math.sqrt(1.0 - normal[least] ** 2)
        i, j = (least + 1) % 3, (least + 2) % 3  # u = normal x e_least / length, which lies in the plane
        u[least], u[i], u[j] = 0.0, normal[j] / length, -normal[i] / length
        for k in range(count + 1):
            angle, distance = 2.0 * math.pi * k / count, 0.0 if k == 0 else radii[n]
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                v = normal[b] * u[c] - normal[c] * u[b]
                probes[n, k, a] = centres[n, a] + distance * (math.cos(angle) * u[a] + math.sin(angle) * v)


@compiled
def side_share(start_x: float, start_y: float, step_x: float, step_y: float) -> tuple[float, float, float]:
    """Twice the signed area, in disc units, between the disc's centre and one side: its part inside gives a triangle,
    the parts outside give sectors. Also where the side enters and leaves the disc."""
    start2 = start_x * start_x + start_y * start_y
    step2 = step_x * step_x + step_y * step_y
    dot = start_x * step_x + start_y * step_y
    cross = start_x * step_y - start_y * step_x
    within = step2 - cross * cross  # dot² - step² (start² - 1), by Lagrange's identity
    if within <= 0.0:  # the line passes the disc: one sector
        return math.atan2(cross, start2 + dot), 0.0, 0.0
    root = math.sqrt(within)
    enter, leave = min(max((-dot - root) / step2, 0.0), 1.0), min(max((-dot + root) / step2, 0.0), 1.0)
    if enter == leave:  # the side does, not its line
        return math.atan2(cross, start2 + dot), enter, leave
    area = (leave - enter) * cross
    if enter > 0.0:
        area += math.atan2(enter * cross, start2 + enter * dot)
    if leave < 1.0:
        area += math.atan2((1.0 - leave) * cross, start2 + (1.0 + leave) * dot + leave * step2)
    return area, enter, leave


@compiled
def reach_of_pixel(m: Array) -> float:
    """Largest distance, in disc units, of a pixel's points from its middle."""
    return 0.5 * math.sqrt(
        max((m[0, 0] + m[0, 1]) ** 2 + (m[1, 0] + m[1, 1]) ** 2, (m[0, 0] - m[0, 1]) ** 2 + (m[1, 0] - m[1, 1]) ** 2)
    )


@compiled
def into_disc(x: float, y: float, m: Array) -> tuple[float, float]:
    """A place in px from the ellipse's centre, in disc units."""
    return m[0, 0] * x + m[0, 1] * y, m[1, 0] * x + m[1, 1] * y


@compiled
def sides_of(column: int, row: int, x: float, y: float, m: Array, before: tuple, below: Array) -> tuple:
    """``side_share`` of the four sides of the pixel in this column and row with middle (x, y): low, high, left, right.

    Neighbours have a side in common: ``before`` is (column, *right side) of the last pixel asked for in this row, and
    ``below`` (w,4) holds (row, *upper side) of the last one in each column, which is renewed.
    """
    a_x, a_y = into_disc(x - 0.5, y - 0.5, m)  # the corner (left, low)
    if before[0] == column - 1:
        left = before[1], before[2], before[3]
    else:
        left = side_share(a_x, a_y, m[0, 1], m[1, 1])
    last = below[column]
    if last[0] == row - 1:
        low = last[1], last[2], last[3]
    else:
        low = side_share(a_x, a_y, m[0, 0], m[1, 0])
    high = side_share(a_x + m[0, 1], a_y + m[1, 1], m[0, 0], m[1, 0])
    right = side_share(a_x + m[0, 0], a_y + m[1, 0], m[0, 1], m[1, 1])
    last[0], last[1], last[2], last[3] = row, high[0], high[1], high[2]
    return low, high, left, right


@compiled
def share_within(m: Array, low: tuple, high: tuple, left: tuple, right: tuple) -> float:
    """Share of a pixel from the ``side_share`` of its sides."""
    return 0.5 / (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * (low[0] - high[0] + right[0] - left[0])


@compiled
def cover_within(
    x: float, y: float, m: Array, of_low: tuple, of_high: tuple, of_left: tuple, of_right: tuple
) -> tuple[float, float, float, float, float, float]:
    """Share of the pixel with middle (x, y), px from the ellipse's centre, and its derivatives by [c_x, c_y, A_xx,
    A_xy, A_yy], from the ``side_share`` of its four sides, of which two run along x and two along y: along each the
    boundary moves by v = dc + dA A^-1 (x - c)."""
    left, right, low, high = x - 0.5, x + 0.5, y - 0.5, y + 0.5
    (_, low_in, low_out), (_, high_in, high_out) = of_low, of_high
    (_, left_in, left_out), (_, right_in, right_out) = of_left, of_right
    share = share_within(m, of_low, of_high, of_left, of_right)

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
def rim_between(reach: float) -> tuple:
    """Squared distances, in disc units, up to which a pixel that reaches so far from its middle lies wholly inside of a
    disc, and from which on outside."""
    return (1.0 - reach) ** 2 if reach < 1.0 else -1.0, (1.0 + reach) ** 2


@compiled
def inverse_of(shape: Array) -> Array:
    """Inverse (2,2) of a (2,2) matrix."""
    det = shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0]
    m = np.empty((2, 2))
    m[0, 0], m[0, 1], m[1, 0], m[1, 1] = shape[1, 1] / det, -shape[0, 1] / det, -shape[1, 0] / det, shape[0, 0] / det
    return m


@compiled
def cover_window(centre_x: float, centre_y: float, shape: Array, shares: Array, derivatives: Array) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5); only pixels on the rim need more than a distance, and
    neighbours have a side in common."""
    height, width = shares.shape
    m = inverse_of(shape)
    reach = reach_of_pixel(m)
    inner, outer = rim_between(reach)
    extent_x, extent_y = math.hypot(shape[0, 0], shape[0, 1]), math.hypot(shape[1, 0], shape[1, 1])
    first, last = max(0, math.ceil(centre_x - extent_x - 0.5)), min(width, math.floor(centre_x + extent_x + 1.5))
    top, bottom = max(0, math.ceil(centre_y - extent_y - 0.5)), min(height, math.floor(centre_y + extent_y + 1.5))
    below = np.full((width, 4), -2.0)
    shares[:] = 0.0
    derivatives[:] = 0.0
    for row in range(top, bottom):
        before = -2.0, 0.0, 0.0, 0.0
        for column in range(first, last):
            x, y = column - centre_x, row - centre_y
            u, v = into_disc(x, y, m)
            distance2 = u * u + v * v
            if distance2 <= inner:
                shares[row, column] = 1.0
            elif distance2 < outer:
                low, high, left, right = sides_of(column, row, x, y, m, before, below)
                before = float(column), right[0], right[1], right[2]
                share, by_x, by_y, by_xx, by_xy, by_yy = cover_within(x, y, m, low, high, left, right)
                shares[row, column] = share
                into = derivatives[row, column]
                into[0], into[1], into[2], into[3], into[4] = by_x, by_y, by_xx, by_xy, by_yy


@compiled
def cover_windows(centres: Array, shapes: Array, shares: Array, derivatives: Array) -> None:
    """``cover_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        cover_window(centres[k, 0], centres[k, 1], shapes[k], shares[k], derivatives[k])


REACH = 5.5  # standard deviations from the rim beyond which no light is followed: 4e-8 of it
POINTS_PER_SIGMA = 1.1  # rim points to one standard deviation of the point spread
FEWEST_POINTS = 24
SQRT_HALF, SQRT_TWO_PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)


@compiled
def carried(start: float, first: int, last: int, psf_px: float, across: Array, passed: Array) -> None:
    """What the point spread carries from ``start``, px along one axis, into pixels first..last: ``across`` g is the
    share of a point's light, ``passed`` P its integral from -infinity to ``start``."""
    u = (first - 0.5 - start) / psf_px
    below = 0.5 * (1.0 + math.erf(u * SQRT_HALF))
    integral = u * below + math.exp(-0.5 * u * u) / SQRT_TWO_PI
    for k in range(first, last + 1):
        u = (k + 0.5 - start) / psf_px
        below_next = 0.5 * (1.0 + math.erf(u * SQRT_HALF))
        integral_next = u * below_next + math.exp(-0.5 * u * u) / SQRT_TWO_PI
        across[k] = below_next - below
        passed[k] = 1.0 - psf_px * (integral_next - integral)
        below, integral = below_next, integral_next


@compiled
def rim_points(shape: Array, psf_px: float) -> int:
    """Points on the rim so close that the trapezoidal rule has converged."""
    extent = math.sqrt(max(shape[0, 0] ** 2 + shape[0, 1] ** 2, shape[1, 0] ** 2 + shape[1, 1] ** 2))
    return max(FEWEST_POINTS, math.ceil(2.0 * math.pi * extent * POINTS_PER_SIGMA / psf_px))


@compiled
def blur_window(
    centre_x: float, centre_y: float, shape: Array, psf_px: float, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5)."""
    height, width = shares.shape
    shares[:] = 0.0
    derivatives[:] = 0.0
    across_x, passed_x, across_y, passed_y = np.empty(width), np.empty(width), np.empty(height), np.empty(height)
    whole = np.zeros((height, width + 1))  # what passes all pixels left of a column
    m, count = inverse_of(shape), rim_points(shape, psf_px)
    scale = 2.0 * math.pi / count * (shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0])
    reach = REACH * psf_px + 0.5
    for k in range(count):
        angle = 2.0 * math.pi * k / count
        u, v = math.cos(angle), math.sin(angle)
        x, y = centre_x + shape[0, 0] * u + shape[0, 1] * v, centre_y + shape[1, 0] * u + shape[1, 1] * v
        n_x, n_y = scale * (m[0, 0] * u + m[1, 0] * v), scale * (m[0, 1] * u + m[1, 1] * v)
        left, right = max(0, math.ceil(x - reach)), min(width - 1, math.floor(x + reach))
        low, high = max(0, math.ceil(y - reach)), min(height - 1, math.floor(y + reach))
        carried(x, left, right, psf_px, across_x, passed_x)
        carried(y, low, high, psf_px, across_y, passed_y)
        for row in range(low, high + 1):
            through = across_y[row] * n_x
            whole[row, min(left, width)] += through
            for column in range(left, right + 1):
                shares[row, column] += through * passed_x[column]
                light = across_y[row] * across_x[column]
                into = derivatives[row, column]
                into[0] += light * n_x
                into[1] += light * n_y
                into[2] += light * u * n_x
                into[3] += light * (v * n_x + u * n_y)
                into[4] += light * v * n_y
    for row in range(height):
        through = 0.0
        for column in range(width - 1, -1, -1):
            through += whole[row, column + 1]
            shares[row, column] += through


@compiled
def blur_windows(centres: Array, shapes: Array, psf_px: float, shares: Array, derivatives: Array) -> None:
    """``blur_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        blur_window(centres[k, 0], centres[k, 1], shapes[k], psf_px, shares[k], derivatives[k])
