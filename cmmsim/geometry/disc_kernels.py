"""Compiled kernels for the image ellipses of discs, and for their blurred light in each pixel.

``disc_image`` states the formulas. ``rim_kernels`` computes the light without blur.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import project


@compiled
def disc_ellipse(centre: Array, normal: Array, radius: float, focal: Array) -> tuple:
    """Return the ellipse x, y, xx, xy, yy of a disc in camera axes through a perfect lens.

    The middle x, y is in normalised coordinates. xx, xy, yy are the entries of A A', px², where A
    maps the unit disc onto the ellipse. The disc must lie wholly in front of the camera.
    """
    squared = radius * radius
    # the dual conic D of ``disc_image``, divided by its last entry D33
    depth = centre[2] * centre[2] - squared * (1.0 - normal[2] * normal[2])
    x = (centre[0] * centre[2] + squared * normal[0] * normal[2]) / depth
    y = (centre[1] * centre[2] + squared * normal[1] * normal[2]) / depth
    dual_xx = (centre[0] * centre[0] - squared * (1.0 - normal[0] * normal[0])) / depth
    dual_xy = (centre[0] * centre[1] + squared * normal[0] * normal[1]) / depth
    dual_yy = (centre[1] * centre[1] - squared * (1.0 - normal[1] * normal[1])) / depth
    return (
        x,
        y,
        focal[0] * focal[0] * (x * x - dual_xx),
        focal[0] * focal[1] * (x * y - dual_xy),
        focal[1] * focal[1] * (y * y - dual_yy),
    )


@compiled
def symmetric_root(xx: float, xy: float, yy: float) -> tuple:
    """Return the entries xx, xy, yy of the square root of a positive definite matrix M (2, 2).

    The square root is (M + d I) / sqrt(trace M + 2 d) with d² = det M.
    """
    d = math.sqrt(max(xx * yy - xy * xy, 0.0))
    scale = math.sqrt(xx + yy + 2.0 * d)
    return (xx + d) / scale, xy / scale, (yy + d) / scale


@compiled
def distorted_root(
    xx: float, xy: float, yy: float, a: float, b: float, c: float, d: float
) -> tuple:
    """Return ``symmetric_root`` of J M J' for the Jacobian J = [[a, b], [c, d]] of a lens."""
    return symmetric_root(
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
    )


@compiled
def project_all(
    centres: Array, normals: Array, radii: Array, focal: Array, principal: Array,
    middles: Array, shapes: Array,
) -> None:  # fmt: skip
    """Fill the ellipses of n discs through a perfect lens: ``middles`` (n, 2) and ``shapes``, px.

    The shapes are (n, 2, 2). The discs have centres and normals (n, 3) in camera axes, and radii
    (n,). ``focal`` (2,) are the focal lengths and ``principal`` (2,) the principal point, px.
    """
    for n in range(len(centres)):
        x, y, xx, xy, yy = disc_ellipse(centres[n], normals[n], radii[n], focal)
        xx, xy, yy = symmetric_root(xx, xy, yy)
        middles[n, 0] = focal[0] * x + principal[0]
        middles[n, 1] = focal[1] * y + principal[1]
        shapes[n, 0, 0] = xx
        shapes[n, 0, 1] = shapes[n, 1, 0] = xy
        shapes[n, 1, 1] = yy


@compiled
def distort_ellipses(camera: Array, middles: Array, shapes: Array) -> None:
    """Replace ellipses of a perfect lens, in place, by those of a camera with intrinsics (9,).

    The distortion is linearised within each ellipse.
    """
    for n in range(len(middles)):
        x = (middles[n, 0] - camera[2]) / camera[0]
        y = (middles[n, 1] - camera[3]) / camera[1]
        u, v, a, b, c, d = project(camera, x, y, 1.0)
        middles[n, 0] = u
        middles[n, 1] = v
        shape = shapes[n]
        xx = shape[0, 0] ** 2 + shape[0, 1] ** 2
        xy = shape[0, 1] * (shape[0, 0] + shape[1, 1])
        yy = shape[0, 1] ** 2 + shape[1, 1] ** 2
        xx, xy, yy = distorted_root(xx, xy, yy, a, b, c, d)
        shape[0, 0] = xx
        shape[0, 1] = shape[1, 0] = xy
        shape[1, 1] = yy


@compiled
def place_discs(
    camera_from_bodies: Array,
    owners: Array,
    places: Array,
    directions: Array,
    centres: Array,
    normals: Array,
) -> None:
    """Fill the centres and normals (n, 3) of discs in camera axes.

    ``places`` and ``directions`` (n, 3) are the centres and normals in the axes of the bodies
    ``owners`` (n,), and ``camera_from_bodies`` is (b, 4, 4).
    """
    for n in range(len(places)):
        move = camera_from_bodies[owners[n]]
        for i in range(3):
            centres[n, i] = move[i, 3]
            normals[n, i] = 0.0
            for j in range(3):
                centres[n, i] += move[i, j] * places[n, j]
                normals[n, i] += move[i, j] * directions[n, j]


@compiled
def probe_discs(centres: Array, normals: Array, radii: Array, probes: Array) -> None:
    """Fill ``probes`` (n, k, 3) with the centre of each disc, then k - 1 points on its rim."""
    count = probes.shape[1] - 1
    u = np.empty(3)
    for n in range(len(centres)):
        normal = normals[n]
        least = 0
        for i in range(1, 3):
            if abs(normal[i]) < abs(normal[least]):
                least = i
        length = math.sqrt(1.0 - normal[least] ** 2)
        # The unit vector u = normal x e_least / length lies in the disc's plane.
        i = (least + 1) % 3
        j = (least + 2) % 3
        u[least] = 0.0
        u[i] = normal[j] / length
        u[j] = -normal[i] / length
        for k in range(count + 1):
            angle = 2.0 * math.pi * k / count
            distance = 0.0 if k == 0 else radii[n]
            for a in range(3):
                b = (a + 1) % 3
                c = (a + 2) % 3
                v = normal[b] * u[c] - normal[c] * u[b]
                probes[n, k, a] = centres[n, a] + distance * (
                    math.cos(angle) * u[a] + math.sin(angle) * v
                )


@compiled
def inverse_shape(shape: Array) -> Array:
    """Return the inverse (2, 2) of a (2, 2) matrix."""
    det = shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0]
    m = np.empty((2, 2))
    m[0, 0] = shape[1, 1] / det
    m[0, 1] = -shape[0, 1] / det
    m[1, 0] = -shape[1, 0] / det
    m[1, 1] = shape[0, 0] / det
    return m


# Distance from the rim at which the point spread is cut off, in standard deviations. This loses a
# fraction 4e-8 of the light.
REACH = 5.5
# Rim points per standard deviation of the point spread, and the smallest number of rim points.
POINTS_PER_SIGMA = 1.1
FEWEST_POINTS = 24
SQRT_HALF = math.sqrt(0.5)
SQRT_TWO_PI = math.sqrt(2.0 * math.pi)


@compiled
def fill_blur_weights(
    start: float, first: int, last: int, psf_px: float, across: Array, passed: Array
) -> None:
    """Fill g and P of ``disc_image`` at the coordinate ``start`` for pixels ``first`` to ``last``.

    The pixel ``last`` is included. ``across`` is g, the fraction of a point's light that reaches a
    pixel along one axis. ``passed`` is P, the integral of g from -infinity to ``start``, px.
    """
    u = (first - 0.5 - start) / psf_px
    below = 0.5 * (1.0 + math.erf(u * SQRT_HALF))
    integral = u * below + math.exp(-0.5 * u * u) / SQRT_TWO_PI
    for k in range(first, last + 1):
        u = (k + 0.5 - start) / psf_px
        below_next = 0.5 * (1.0 + math.erf(u * SQRT_HALF))
        integral_next = u * below_next + math.exp(-0.5 * u * u) / SQRT_TWO_PI
        across[k] = below_next - below
        passed[k] = 1.0 - psf_px * (integral_next - integral)
        below = below_next
        integral = integral_next


@compiled
def rim_points(shape: Array, psf_px: float) -> int:
    """Return the number of points on the rim with which the trapezoidal rule has converged."""
    extent = math.sqrt(
        max(shape[0, 0] ** 2 + shape[0, 1] ** 2, shape[1, 0] ** 2 + shape[1, 1] ** 2)
    )
    return max(FEWEST_POINTS, math.ceil(2.0 * math.pi * extent * POINTS_PER_SIGMA / psf_px))


@compiled
def blur_window(
    centre_x: float, centre_y: float, shape: Array, psf_px: float, shares: Array, derivatives: Array
) -> None:
    """Fill the light ``shares`` (h, w) and its ``derivatives`` (h, w, 5) for a blurred ellipse.

    The arguments are those of ``disc_image.coverage``, for a single ellipse.
    """
    height, width = shares.shape
    shares[:] = 0.0
    derivatives[:] = 0.0
    across_x = np.empty(width)
    passed_x = np.empty(width)
    across_y = np.empty(height)
    passed_y = np.empty(height)
    # contributions to all pixels to the left of each column
    to_the_left = np.zeros((height, width + 1))
    m = inverse_shape(shape)
    count = rim_points(shape, psf_px)
    # On the rim, n ds = det(A) A^-T u dt.
    scale = 2.0 * math.pi / count * (shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0])
    reach = REACH * psf_px + 0.5
    for k in range(count):
        angle = 2.0 * math.pi * k / count
        u = math.cos(angle)
        v = math.sin(angle)
        x = centre_x + shape[0, 0] * u + shape[0, 1] * v
        y = centre_y + shape[1, 0] * u + shape[1, 1] * v
        n_x = scale * (m[0, 0] * u + m[1, 0] * v)
        n_y = scale * (m[0, 1] * u + m[1, 1] * v)
        left = max(0, math.ceil(x - reach))
        right = min(width - 1, math.floor(x + reach))
        low = max(0, math.ceil(y - reach))
        high = min(height - 1, math.floor(y + reach))
        fill_blur_weights(x, left, right, psf_px, across_x, passed_x)
        fill_blur_weights(y, low, high, psf_px, across_y, passed_y)
        for row in range(low, high + 1):
            through = across_y[row] * n_x
            # for pixels farther left, P is 1; the last loop adds these contributions
            to_the_left[row, min(left, width)] += through
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
            through += to_the_left[row, column + 1]
            shares[row, column] += through


@compiled
def blur_windows(
    centres: Array, shapes: Array, psf_px: float, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (n, h, w) and ``derivatives`` (n, h, w, 5), see ``blur_window``."""
    for k in range(len(centres)):
        blur_window(centres[k, 0], centres[k, 1], shapes[k], psf_px, shares[k], derivatives[k])
