"""Compiled kernels of the maximum-likelihood fit of an ellipse to the grey values of a window.

``ellipse_fit`` describes the model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.detection.light_kernels import EVEN_UNKNOWNS as UNKNOWNS
from cmmsim.detection.light_kernels import (
    LIT_UNKNOWNS,
    accumulate_lit,
    light_across,
    variance_at,
)
from cmmsim.detection.start_kernels import bound_radii, moments, start_ellipse
from cmmsim.geometry.disc_kernels import blur_window, inverse_shape
from cmmsim.geometry.matrix_kernels import factorise, invert_factored, solve_factored
from cmmsim.geometry.rim_kernels import cover_window


class FitSettings(NamedTuple):
    """Settings of a fit.

    ring_reach      factor by which the start ellipse is enlarged; the pixels inside are fitted
    smallest        smallest semi-axis, px
    largest_step    (9,), largest step of each parameter
    iterations      largest number of steps
    converged       a fit ends after a step that changes centre and shape by less than this, px
    psf_px          standard deviation of the point spread, or 0
    smear_step      largest distance between the positions over which the light of a moving ellipse
                    is summed, px
    variances       table of noise variances by mean grey value
    first_grey      grey value at which the table begins
    grey_entries    number of table entries per grey value
    black           grey value without light
    """

    ring_reach: float
    smallest: float
    largest_step: Array
    iterations: int
    converged: float
    psf_px: float
    smear_step: float
    variances: Array
    first_grey: float
    grey_entries: float
    black: float


@compiled
def accumulate(
    window: Array,
    mask: Array,
    shares: Array,
    derivatives: Array,
    contrast: float,
    ground: float,
    settings: FitSettings,
    normal: Array,
    right: Array,
) -> float:
    """Fill the lower triangle of the normal matrix (7, 7), and the right-hand side (7,).

    Return the weighted sum of squared residuals. All pixels outside the ellipse have the same mean,
    and so have all pixels inside. Therefore only sums over their residuals are needed.
    """
    # for each pixel on the rim: the derivatives of its mean, the residual, and the weight
    rows = np.empty((window.size, UNKNOWNS + 2))
    count = 0
    misfit = 0.0
    outside = 0
    outside_sum = 0.0
    outside_squares = 0.0
    inside = 0
    inside_sum = 0.0
    inside_squares = 0.0
    for row in range(window.shape[0]):
        for column in range(window.shape[1]):
            if not mask[row, column]:
                continue
            share = shares[row, column]
            mean = ground + contrast * share
            residual = window[row, column] - mean
            if share == 0.0:
                outside += 1
                outside_sum += residual
                outside_squares += residual * residual
            elif share == 1.0:
                inside += 1
                inside_sum += residual
                inside_squares += residual * residual
            else:
                weight = 1.0 / variance_at(mean, settings)
                change = derivatives[row, column]
                pixel = rows[count]
                misfit += weight * residual * residual
                for i in range(5):
                    pixel[i] = contrast * change[i]
                pixel[5] = share
                pixel[6] = 1.0
                pixel[7] = residual
                pixel[8] = weight
                count += 1
    add_products(rows[:count], normal, right)
    dark = 1.0 / variance_at(ground, settings)
    bright = 1.0 / variance_at(ground + contrast, settings)
    normal[6, 6] += dark * outside + bright * inside
    normal[5, 5] += bright * inside
    normal[6, 5] += bright * inside
    right[6] += dark * outside_sum + bright * inside_sum
    right[5] += bright * inside_sum
    return misfit + dark * outside_squares + bright * inside_squares


@compiled
def add_products(rows: Array, normal: Array, right: Array) -> None:
    """Fill the normal matrix (7, 7) and the right-hand side (7,) from rows (n, 9).

    A row has the derivatives with respect to the seven parameters, the residual, and the weight.
    Each sum is a separate scalar variable, so that the compiler can use vector instructions.
    """
    for i in range(UNKNOWNS):
        s_0 = 0.0
        s_1 = 0.0
        s_2 = 0.0
        s_3 = 0.0
        s_4 = 0.0
        s_5 = 0.0
        s_6 = 0.0
        s_7 = 0.0
        for n in range(len(rows)):
            row = rows[n]
            weighted = row[8] * row[i]
            s_0 += weighted * row[0]
            s_1 += weighted * row[1]
            s_2 += weighted * row[2]
            s_3 += weighted * row[3]
            s_4 += weighted * row[4]
            s_5 += weighted * row[5]
            s_6 += weighted * row[6]
            s_7 += weighted * row[7]
        sums = normal[i]
        sums[0] = s_0
        sums[1] = s_1
        sums[2] = s_2
        sums[3] = s_3
        sums[4] = s_4
        sums[5] = s_5
        sums[6] = s_6
        right[i] = s_7  # fmt: skip


@compiled
def mask_ring(parameters: Array, shape: Array, reach: float, mask: Array) -> int:
    """Fill the mask (h, w) of pixels in the ellipse enlarged by ``reach``; return their number."""
    m = inverse_shape(shape)
    count = 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            x = column - parameters[0]
            y = row - parameters[1]
            mask[row, column] = (
                (m[0, 0] * x + m[0, 1] * y) ** 2 + (m[1, 0] * x + m[1, 1] * y) ** 2
            ) < reach * reach
            count += mask[row, column]
    return count


@compiled
def step_within_bounds(parameters: Array, step: Array, settings: FitSettings, size: int) -> float:
    """Add a step, limited to ``largest_step``, to the parameters.

    The centre is then limited to the window, and the semi-axes to their range. Return the largest
    change of a parameter of centre or shape, px, before these limits.
    """
    moved = 0.0
    for k in range(len(parameters)):
        change = min(max(step[k], -settings.largest_step[k]), settings.largest_step[k])
        parameters[k] += change
        if k < 5:
            moved = max(moved, abs(change))
    for k in range(2):
        parameters[k] = min(max(parameters[k], 0.0), size - 1.0)
    parameters[2], parameters[3], parameters[4] = bound_radii(
        parameters[2], parameters[3], parameters[4], settings.smallest, float(size)
    )
    return moved


@compiled
def set_shape(parameters: Array, shape: Array) -> None:
    """Fill the matrix A (2, 2) from the parameters of an ellipse."""
    shape[0, 0] = parameters[2]
    shape[0, 1] = parameters[3]
    shape[1, 0] = parameters[3]
    shape[1, 1] = parameters[4]


@compiled
def light_of_still(
    centre_x: float, centre_y: float, shape: Array, psf_px: float, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5) for an ellipse at rest."""
    if psf_px > 0.0:
        blur_window(centre_x, centre_y, shape, psf_px, shares, derivatives)
    else:
        cover_window(centre_x, centre_y, shape, shares, derivatives)


@compiled
def add_light(
    shares: Array, derivatives: Array, weight: float, to_shares: Array, to_derivatives: Array
) -> None:
    """Add weighted shares (h, w) and derivatives (h, w, 5) to ``to_shares`` and ``to_derivatives``.

    The loops are explicit because sums of whole arrays take seconds to compile.
    """
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            to_shares[row, column] += weight * shares[row, column]
            for k in range(derivatives.shape[2]):
                to_derivatives[row, column, k] += weight * derivatives[row, column, k]


@compiled
def light_of_moving(
    parameters: Array,
    shape: Array,
    smear: Array,
    settings: FitSettings,
    shares: Array,
    derivatives: Array,
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5) for an ellipse at constant velocity.

    The ellipse moves by ``smear`` (2,) px during the exposure, and its parameters are those at the
    middle of the exposure. The light is integrated by the midpoint rule.
    """
    count = math.ceil(math.hypot(smear[0], smear[1]) / settings.smear_step)
    if count <= 1:
        light_of_still(parameters[0], parameters[1], shape, settings.psf_px, shares, derivatives)
        return
    total = np.zeros(shares.shape)
    changes = np.zeros(derivatives.shape)
    for k in range(count):
        part = (k + 0.5) / count - 0.5
        light_of_still(
            parameters[0] + part * smear[0],
            parameters[1] + part * smear[1],
            shape,
            settings.psf_px,
            shares,
            derivatives,
        )
        add_light(shares, derivatives, 1.0, total, changes)
    shares[:] = 0.0
    derivatives[:] = 0.0
    add_light(total, changes, 1.0 / count, shares, derivatives)


@compiled
def fit_window(
    window: Array,
    smear: Array,
    settings: FitSettings,
    parameters: Array,
    shape: Array,
    covariance: Array,
    light: Array,
) -> float:
    """Fit one ellipse by Gauss-Newton steps; return the reduced chi-square.

    ``parameters`` contain the start values and are replaced by the result. They are seven, or nine
    if light that rises across the sticker is fitted too. The ellipse moves by ``smear`` (2,) px
    during the exposure. The normal matrix and the misfit are those from before the last step. Fills
    the ellipse's ``shape`` (2, 2) and the ``covariance`` (m, m) of its first m parameters.
    ``light`` (7,) is filled by ``light_across`` for seven parameters, and with zeros for nine.
    """
    unknowns = len(parameters)
    size = len(window)
    mask = np.empty((size, size), np.bool_)
    shares = np.empty((size, size))
    derivatives = np.empty((size, size, 5))
    normal = np.empty((unknowns, unknowns))
    right = np.empty(unknowns)
    start = parameters[:2].copy()
    last = parameters.copy()
    set_shape(parameters, shape)
    # the mask of the start is used throughout, so that all steps minimise the same sum
    freedom = max(mask_ring(parameters, shape, settings.ring_reach, mask) - unknowns, 1)
    misfit = 0.0
    for iteration in range(settings.iterations + 1):
        light_of_moving(parameters, shape, smear, settings, shares, derivatives)
        if unknowns == LIT_UNKNOWNS:
            misfit = accumulate_lit(
                window, mask, shares, derivatives, parameters, start, settings, normal, right
            )
        else:
            misfit = accumulate(
                window, mask, shares, derivatives, parameters[5], parameters[6], settings,
                normal, right,
            )  # fmt: skip
        for k in range(unknowns):
            # keep the factor finite if the window does not determine a parameter
            normal[k, k] += 1e-9
        factorise(normal)
        solve_factored(normal, right)
        last[:] = parameters
        if iteration == settings.iterations:
            break
        moved = step_within_bounds(parameters, right, settings, size)
        set_shape(parameters, shape)
        if moved < settings.converged:
            break
    light[:] = 0.0
    if unknowns == UNKNOWNS:
        light_across(window, mask, shares, derivatives, last, settings, normal, right, light)
    invert_factored(normal, covariance)
    return misfit / freedom


@compiled
def fit_windows(
    windows: Array,
    smears: Array,
    size: int,
    settings: FitSettings,
    corners: Array,
    parameters: Array,
    shapes: Array,
    covariances: Array,
    misfits: Array,
    lights: Array,
) -> None:
    """Fit the part of ``size`` px around the bright spot of each window (n, h, h) of floats.

    The spots move by ``smears`` (n, 2) px during the exposure. Fills the corners (n, 2) of the
    parts within their windows, the parameters (n, 7) or (n, 9), the shapes (n, 2, 2), the
    covariances (n, m, m) of the first m parameters, the misfits (n,) and the ``lights`` (n, 7). The
    centres among the parameters are relative to the corners.
    """
    for k in range(len(windows)):
        spot = moments(windows[k])
        room = windows.shape[1] - size
        left = min(max(int(np.rint(spot[2] - 0.5 * (size - 1))), 0), room)
        top = min(max(int(np.rint(spot[3] - 0.5 * (size - 1))), 0), room)
        # contiguous, as whole windows are: Numba compiles what takes both only once
        part = windows[k, top : top + size, left : left + size].copy()
        parameters[k] = 0.0
        start_ellipse(moments(part) if room else spot, size, parameters[k])
        misfits[k] = fit_window(
            part, smears[k], settings, parameters[k], shapes[k], covariances[k], lights[k]
        )
        corners[k, 0] = left
        corners[k, 1] = top
