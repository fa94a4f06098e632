"""Compiled: discs as a camera sees them, and their blurred light in pixels; the formulas stand in ``disc_image``."""

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
def inverse_shape(shape: Array) -> Array:
    """Inverse (2,2) of a (2,2) matrix."""
    det = shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0]
    m = np.empty((2, 2))
    m[0, 0], m[0, 1], m[1, 0], m[1, 1] = shape[1, 1] / det, -shape[0, 1] / det, -shape[1, 0] / det, shape[0, 0] / det
    return m


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
    m, count = inverse_shape(shape), rim_points(shape, psf_px)
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
