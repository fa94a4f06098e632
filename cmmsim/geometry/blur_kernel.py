"""Compiled: light of an ellipse blurred by a Gaussian in each pixel, see ``blurred_coverage`` for the formulas."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import compiled
from cmmsim.geometry.coverage_kernel import inverse_of

REACH = 5.5  # standard deviations from the rim beyond which no light is followed: 4e-8 of it
POINTS_PER_SIGMA = 1.1  # rim points to one standard deviation of the point spread
FEWEST_POINTS = 24
SQRT_HALF, SQRT_TWO_PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)


@compiled
def carried(start: float, first: int, last: int, psf_px: float, across: np.ndarray, passed: np.ndarray) -> None:
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
def rim_points(shape: np.ndarray, psf_px: float) -> int:
    """Points on the rim so close that the trapezoidal rule has converged."""
    extent = math.sqrt(max(shape[0, 0] ** 2 + shape[0, 1] ** 2, shape[1, 0] ** 2 + shape[1, 1] ** 2))
    return max(FEWEST_POINTS, math.ceil(2.0 * math.pi * extent * POINTS_PER_SIGMA / psf_px))


@compiled
def blur_window(
    centre_x: float, centre_y: float, shape: np.ndarray, psf_px: float, shares: np.ndarray, derivatives: np.ndarray
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5)."""
    height, width = shares.shape
    shares[:] = 0.0
    derivatives[:] = 0.0
    across_x, passed_x, across_y, passed_y = np.empty(width), np.empty(width), np.empty(height), np.empty(height)
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
            for column in range(min(left, width)):  # all that lies left of here has been passed
                shares[row, column] += through
            for column in range(left, right + 1):
                shares[row, column] += through * passed_x[column]
                light = across_y[row] * across_x[column]
                into = derivatives[row, column]
                into[0] += light * n_x
                into[1] += light * n_y
                into[2] += light * u * n_x
                into[3] += light * (v * n_x + u * n_y)
                into[4] += light * v * n_y


@compiled
def blur_windows(
    centres: np.ndarray, shapes: np.ndarray, psf_px: float, shares: np.ndarray, derivatives: np.ndarray
) -> None:
    """``blur_window`` for n ellipses: centres (n,2), shapes (n,2,2), shares (n,h,w), derivatives (n,h,w,5)."""
    for k in range(len(centres)):
        blur_window(centres[k, 0], centres[k, 1], shapes[k], psf_px, shares[k], derivatives[k])
