"""Compiled kernels for stickers that are brighter on one side than on the other.

Light that rises across a sticker multiplies the light of the sticker and its ring by
1 + g_x x + g_y y, where x and y are distances from a fixed point in the window, px. Where a blurred
rim crosses a pixel, the mean place of the light that reaches the pixel is not the middle of the
pixel. Let s be the share of light in a pixel at x, and c_x the x coordinate of the centre of the
ellipse. By Stein's identity, s times the mean place is then s x - v ds/dc_x. Point spread and pixel
together are taken as a Gaussian with the variance v.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.matrix_kernels import solve_factored

if TYPE_CHECKING:
    from cmmsim.detection.ellipse_fit_kernels import FitSettings

EVEN_UNKNOWNS = 7  # c_x, c_y, A_xx, A_xy, A_yy, contrast, ground
LIT_UNKNOWNS = 9  # the same, then g_x and g_y
PIXEL_VARIANCE = 1.0 / 12.0  # of a uniform distribution over one pixel, px²


@compiled
def variance_at(mean: float, settings: FitSettings) -> float:
    """Return the noise variance of a mean grey value, interpolated linearly in the table.

    Beyond the ends of the table, it is extrapolated.
    """
    entry = (mean - settings.first_grey) * settings.grey_entries
    k = min(max(int(entry), 0), len(settings.variances) - 2)
    return settings.variances[k] + (entry - k) * (settings.variances[k + 1] - settings.variances[k])


@compiled
def accumulate_lit(
    window: Array, mask: Array, shares: Array, derivatives: Array, parameters: Array, start: Array,
    settings: FitSettings, normal: Array, right: Array,
) -> float:  # fmt: skip
    """Fill the lower triangle of the normal matrix (9, 9), and the right-hand side (9,).

    Return the weighted sum of squared residuals. ``start`` (2,) px is the fixed point in the
    window, at which the light does not change.
    """
    variance = settings.psf_px * settings.psf_px + PIXEL_VARIANCE
    contrast = parameters[5]
    ground = parameters[6] - settings.black
    g_x = parameters[7]
    g_y = parameters[8]
    row = np.empty(LIT_UNKNOWNS)
    normal[:] = 0.0
    right[:] = 0.0
    misfit = 0.0
    for i in range(window.shape[0]):
        for j in range(window.shape[1]):
            if not mask[i, j]:
                continue
            x = j - start[0]
            y = i - start[1]
            share = shares[i, j]
            change = derivatives[i, j]
            factor = 1.0 + g_x * x + g_y * y
            for k in range(5):
                row[k] = contrast * factor * change[k]
            row[5] = factor * share - variance * (g_x * change[0] + g_y * change[1])
            row[6] = factor
            row[7] = ground * x + contrast * (share * x - variance * change[0])
            row[8] = ground * y + contrast * (share * y - variance * change[1])
            mean = settings.black + ground * factor + contrast * row[5]
            weight = 1.0 / variance_at(mean, settings)
            residual = window[i, j] - mean
            misfit += weight * residual * residual
            for a in range(LIT_UNKNOWNS):
                weighted = weight * row[a]
                right[a] += weighted * residual
                for b in range(a + 1):
                    normal[a, b] += weighted * row[b]
    return misfit


@compiled
def light_across(
    window: Array, mask: Array, shares: Array, derivatives: Array, parameters: Array,
    settings: FitSettings, lower: Array, step: Array, light: Array,
) -> None:  # fmt: skip
    """Fill the entries (7,) of ``EllipseFits.lights`` for one window.

    The first five are exact to first order in the slope of the light. They are zero if the pixels
    do not determine the slope. ``parameters`` (7,) are those of the last normal matrix, whose
    Cholesky factor is ``lower``. ``step`` (7,) is the step that follows from this matrix.
    """
    variance = settings.psf_px * settings.psf_px + PIXEL_VARIANCE
    contrast = parameters[5]
    ground = parameters[6] - settings.black
    mixed = np.zeros((3, EVEN_UNKNOWNS))
    by_slope = np.empty(2)
    own_blur = right_blur = 0.0
    end = window.shape[0] - 1
    wide = window.shape[1] - 1
    own_xx = own_xy = own_yy = 0.0
    right_x = right_y = 0.0
    dark = 1.0 / variance_at(parameters[6], settings)
    bright = 1.0 / variance_at(parameters[6] + contrast, settings)
    for i in range(window.shape[0]):
        y = i - parameters[1]
        for j in range(window.shape[1]):
            if not mask[i, j]:
                continue
            x = j - parameters[0]
            share = shares[i, j]
            mean = parameters[6] + contrast * share
            inner = ground + contrast * share
            by_slope[0] = inner * x
            by_slope[1] = inner * y
            weight = dark if share == 0.0 else bright
            if 0.0 < share < 1.0:
                weight = 1.0 / variance_at(mean, settings)
                change = derivatives[i, j]
                by_slope[0] -= contrast * variance * change[0]
                by_slope[1] -= contrast * variance * change[1]
                for k in range(2):
                    weighted = weight * by_slope[k] * contrast
                    for a in range(5):
                        mixed[k, a] += weighted * change[a]
            # The light that a blur brings to a pixel from its neighbours.
            blur = contrast * (
                shares[max(i - 1, 0), j] + shares[min(i + 1, end), j]
                + shares[i, max(j - 1, 0)] + shares[i, min(j + 1, wide)] - 4.0 * share
            )  # fmt: skip
            residual = weight * (window[i, j] - mean)
            if blur != 0.0:
                weighted = weight * blur
                right_blur += blur * residual
                own_blur += weighted * blur
                mixed[2, 5] += weighted * share
                mixed[2, 6] += weighted
                if 0.0 < share < 1.0:
                    for a in range(5):
                        mixed[2, a] += weighted * contrast * derivatives[i, j, a]
            right_x += by_slope[0] * residual
            right_y += by_slope[1] * residual
            own_xx += weight * by_slope[0] * by_slope[0]
            own_xy += weight * by_slope[0] * by_slope[1]
            own_yy += weight * by_slope[1] * by_slope[1]
            for k in range(2):
                mixed[k, 5] += weight * by_slope[k] * share
                mixed[k, 6] += weight * by_slope[k]
    taken = mixed.copy()
    for k in range(3):
        solve_factored(lower, taken[k])
    for a in range(EVEN_UNKNOWNS):
        right_blur -= mixed[2, a] * step[a]
        own_blur -= mixed[2, a] * taken[2, a]
        right_x -= mixed[0, a] * step[a]
        right_y -= mixed[1, a] * step[a]
        own_xx -= mixed[0, a] * taken[0, a]
        own_xy -= mixed[0, a] * taken[1, a]
        own_yy -= mixed[1, a] * taken[1, a]
    determinant = own_xx * own_yy - own_xy * own_xy
    light[:] = 0.0
    light[5] = right_blur
    light[6] = own_blur
    if not (own_xx > 0.0 and determinant > 0.0):
        return
    spread_xx = own_yy / determinant
    spread_xy = -own_xy / determinant
    spread_yy = own_xx / determinant
    g_x = spread_xx * right_x + spread_xy * right_y
    g_y = spread_xy * right_x + spread_yy * right_y
    light[0] = -taken[0, 0] * g_x - taken[1, 0] * g_y
    light[1] = -taken[0, 1] * g_x - taken[1, 1] * g_y
    # The shift is -T' g. T is the part of ``taken`` for slope and centre, and g the fitted slope of
    # the light. With the covariance S of g, the covariance of the shift is T' S T.
    for k in range(3):
        a = 0 if k < 2 else 1
        b = 0 if k < 1 else 1
        light[2 + k] = (
            taken[0, a] * (spread_xx * taken[0, b] + spread_xy * taken[1, b])
            + taken[1, a] * (spread_xy * taken[0, b] + spread_yy * taken[1, b])
        )  # fmt: skip
