"""Compiled: the maximum-likelihood fit of one ellipse to the grey values of one window, see ``ellipse_fit``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.geometry.disc_kernels import blur_window, inverse_of
from cmmsim.geometry.point_kernels import factor, invert_factored, solve_factored
from cmmsim.geometry.rim_kernels import cover_window

UNKNOWNS = 7  # c_x, c_y, A_xx, A_xy, A_yy, contrast, ground
CORE_SHARE = 0.4  # a pixel with this share of the contrast belongs to the bright spot when the fit starts
SMALLEST_START_PX = 1.2
RANK_STEPS = 256  # a grey value each at 8 bit


class FitSettings(NamedTuple):
    """ring_reach: radii of the ellipse within which pixels are fitted; smallest radius px; largest_step (7,);
    iterations at most, and the step in px below which they end; psf_px of the point spread, or 0; smear_step px between
    two places of a moving ellipse whose light is added; variances of grey values from ``first_grey`` on,
    ``entries_a_grey`` for each."""

    ring_reach: float
    smallest: float
    largest_step: Array
    iterations: int
    converged: float
    psf_px: float
    smear_step: float
    variances: Array
    first_grey: float
    entries_a_grey: float


@compiled
def nth_smallest(values: Array, n: int) -> float:
    """The value with ``n`` smaller ones (Hoare's selection); reorders ``values``."""
    first, last = 0, len(values) - 1
    while first < last:
        pivot, low, high = values[n], first, last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while pivot < values[high]:
                high -= 1
            if low <= high:
                values[low], values[high] = values[high], values[low]
                low, high = low + 1, high - 1
        if high < n:
            first = low
        if n < low:
            last = high
    return values[n]


@compiled
def two_of_rank(values: Array, low_rank: int, high_rank: int) -> tuple:
    """The values with ``low_rank`` and with ``high_rank`` smaller ones, of finite ones; reorders ``values``.

    They are counted in even steps between the smallest and the largest, and sorted only where a rank falls.
    """
    smallest, largest = values[0], values[0]
    for value in values:
        smallest, largest = min(smallest, value), max(largest, value)
    if not smallest < largest:
        return smallest, largest
    scale, counts = (RANK_STEPS - 1) / (largest - smallest), np.zeros(RANK_STEPS, np.int64)
    for value in values:
        counts[int((value - smallest) * scale)] += 1
    low_step, low_before = step_of_rank(counts, low_rank)
    high_step, high_before = step_of_rank(counts, high_rank)
    found = np.empty(max(counts[low_step], counts[high_step]))
    low = nth_in_step(values, smallest, scale, low_step, found, low_rank - low_before)
    return low, nth_in_step(values, smallest, scale, high_step, found, high_rank - high_before)


@compiled
def step_of_rank(counts: Array, rank: int) -> tuple:
    """The step in which the value with ``rank`` smaller ones falls, and how many fall before."""
    step, before = 0, 0
    while before + counts[step] <= rank:
        before += counts[step]
        step += 1
    return step, before


@compiled
def nth_in_step(values: Array, smallest: float, scale: float, step: int, found: Array, n: int) -> float:
    """The value of a step with ``n`` smaller ones in it; ``found`` is overwritten."""
    count, same = 0, True
    for value in values:
        if int((value - smallest) * scale) == step:
            found[count] = value
            same = same and value == found[0]
            count += 1
    return found[0] if same else nth_smallest(found[:count], n)


@compiled
def moments(window: Array) -> tuple:
    """Ground, contrast, centroid x, y and spread xx, xy, yy of the bright spot of a window (h, w) of floats."""
    flat = window.flatten()
    ground, bright = two_of_rank(flat, len(flat) // 3, len(flat) - 6)
    contrast = max(bright - ground, 1.0)
    area, x, y, xx, xy, yy = 1e-300, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(window.shape[0]):
        for column in range(window.shape[1]):
            share = (window[row, column] - ground) / contrast
            if share > CORE_SHARE:
                share = min(share, 1.0)
                area += share
                x += share * column
                y += share * row
                xx += share * column * column
                xy += share * column * row
                yy += share * row * row
    x, y = x / area, y / area
    return ground, contrast, x, y, xx / area - x * x, xy / area - x * y, yy / area - y * y


@compiled
def bound_radii(xx: float, xy: float, yy: float, lowest: float, highest: float) -> tuple:
    """A symmetric (2,2) matrix with its eigenvalues kept between two limits, given and returned as xx, xy, yy."""
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    large, small = mean + half, mean - half
    if small >= lowest and large <= highest:
        return xx, xy, yy
    bounded_large, bounded_small = min(max(large, lowest), highest), min(max(small, lowest), highest)
    if half == 0.0:
        return bounded_large, 0.0, bounded_large
    scale, middle = (bounded_large - bounded_small) / (2.0 * half), 0.5 * (bounded_large + bounded_small)
    return middle + scale * (xx - mean), scale * xy, middle + scale * (yy - mean)


@compiled
def variance_at(mean: float, settings: FitSettings) -> float:
    """Noise variance of a grey value, linear between the table's entries."""
    place = (mean - settings.first_grey) * settings.entries_a_grey
    k = min(max(int(place), 0), len(settings.variances) - 2)
    return settings.variances[k] + (place - k) * (settings.variances[k + 1] - settings.variances[k])


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
    """Add up the normal matrix (7,7), lower triangle, and right-hand side (7,); returns the weighted squared misfit.

    Pixels wholly outside or inside of the ellipse share a mean, and only their residuals' sums are needed.
    """
    normal[:], right[:], misfit = 0.0, 0.0, 0.0
    row_of = np.empty(UNKNOWNS)
    row_of[6] = 1.0
    outside, outside_sum, outside_squares, inside, inside_sum, inside_squares = 0, 0.0, 0.0, 0, 0.0, 0.0
    for row in range(window.shape[0]):
        for column in range(window.shape[1]):
            if not mask[row, column]:
                continue
            share, change = shares[row, column], derivatives[row, column]
            mean = ground + contrast * share
            if share == 0.0:
                outside += 1
                outside_sum += window[row, column] - mean
                outside_squares += (window[row, column] - mean) ** 2
                continue
            if share == 1.0:
                inside += 1
                inside_sum += window[row, column] - mean
                inside_squares += (window[row, column] - mean) ** 2
                continue
            weight = 1.0 / variance_at(mean, settings)
            residual = window[row, column] - mean
            misfit += weight * residual * residual
            row_of[5] = share
            for i in range(5):
                row_of[i] = contrast * change[i]
            for i in range(UNKNOWNS):
                weighted = weight * row_of[i]
                right[i] += weighted * residual
                for j in range(i + 1):
                    normal[i, j] += weighted * row_of[j]
    dark, bright = 1.0 / variance_at(ground, settings), 1.0 / variance_at(ground + contrast, settings)
    normal[6, 6] += dark * outside + bright * inside
    normal[5, 5] += bright * inside
    normal[6, 5] += bright * inside
    right[6] += dark * outside_sum + bright * inside_sum
    right[5] += bright * inside_sum
    return misfit + dark * outside_squares + bright * inside_squares


@compiled
def start_ellipse(spot: tuple, size: int, parameters: Array) -> None:
    """First parameters (7,) from the moments of a window of ``size`` px; a uniform ellipse has spread A A / 4."""
    ground, contrast, x, y, xx, xy, yy = spot
    xx, xy, yy = bound_radii(xx, xy, yy, (0.5 * SMALLEST_START_PX) ** 2, (0.25 * size) ** 2)
    root = math.sqrt(xx * yy - xy * xy)
    scale = 2.0 / math.sqrt(xx + yy + 2.0 * root)  # the root of a matrix M is (M + sqrt(det) 1) / sqrt(...)
    parameters[0], parameters[1] = x, y
    parameters[2], parameters[3], parameters[4] = scale * (xx + root), scale * xy, scale * (yy + root)
    parameters[5], parameters[6] = contrast, ground


@compiled
def mask_ring(parameters: Array, shape: Array, reach: float, mask: Array) -> int:
    """Mark the pixels within ``reach`` radii of the ellipse; returns their number."""
    m, count = inverse_of(shape), 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            x, y = column - parameters[0], row - parameters[1]
            mask[row, column] = ((m[0, 0] * x + m[0, 1] * y) ** 2 + (m[1, 0] * x + m[1, 1] * y) ** 2) < reach * reach
            count += mask[row, column]
    return count


@compiled
def step_within_bounds(parameters: Array, step: Array, settings: FitSettings, size: int) -> float:
    """Add a step (7,), cut to its largest values, and keep the centre in the window and the radii between limits.

    Returns how far the ellipse was to move, px.
    """
    moved = 0.0
    for k in range(UNKNOWNS):
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
    """The matrix A (2,2) of an ellipse's parameters."""
    shape[0, 0], shape[0, 1], shape[1, 0], shape[1, 1] = parameters[2], parameters[3], parameters[3], parameters[4]


@compiled
def light_of_still(
    centre_x: float, centre_y: float, shape: Array, psf_px: float, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5) of an ellipse that stands still."""
    if psf_px > 0.0:
        blur_window(centre_x, centre_y, shape, psf_px, shares, derivatives)
    else:
        cover_window(centre_x, centre_y, shape, shares, derivatives)


@compiled
def add_light(shares: Array, derivatives: Array, weight: float, to_shares: Array, to_derivatives: Array) -> None:
    """Add shares (h, w) and derivatives (h, w, 5), weighted, to others; whole-array sums would compile for seconds."""
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            to_shares[row, column] += weight * shares[row, column]
            for k in range(derivatives.shape[2]):
                to_derivatives[row, column, k] += weight * derivatives[row, column, k]


@compiled
def light_of_moving(
    parameters: Array, shape: Array, smear: Array, settings: FitSettings, shares: Array, derivatives: Array
) -> None:
    """Fill ``shares`` (h, w) and ``derivatives`` (h, w, 5) of an ellipse that moves evenly by ``smear`` (2,) px during
    the exposure, by the midpoint rule; its parameters are those in the middle."""
    count = math.ceil(math.hypot(smear[0], smear[1]) / settings.smear_step)
    if count <= 1:
        light_of_still(parameters[0], parameters[1], shape, settings.psf_px, shares, derivatives)
        return
    total, changes = np.zeros(shares.shape), np.zeros(derivatives.shape)
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
    window: Array, smear: Array, settings: FitSettings, parameters: Array, shape: Array, covariance: Array
) -> float:
    """Gauss-Newton from ``parameters`` (7,), which it moves; returns the reduced chi-square.

    It ends when the ellipse moves by less than ``converged`` px: the normal matrix and the misfit of that last step
    are those of the result. Fills the ellipse's ``shape`` (2,2) and the ``covariance`` (m,m) of its first m parameters.
    """
    size = len(window)
    mask = np.empty((size, size), np.bool_)
    shares, derivatives = np.empty((size, size)), np.empty((size, size, 5))
    normal, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    set_shape(parameters, shape)
    freedom = max(mask_ring(parameters, shape, settings.ring_reach, mask) - UNKNOWNS, 1)
    misfit = 0.0
    for iteration in range(settings.iterations + 1):
        light_of_moving(parameters, shape, smear, settings, shares, derivatives)
        misfit = accumulate(window, mask, shares, derivatives, parameters[5], parameters[6], settings, normal, right)
        for k in range(UNKNOWNS):
            normal[k, k] += 1e-9
        factor(normal)
        if iteration == settings.iterations:
            break
        solve_factored(normal, right)
        moved = step_within_bounds(parameters, right, settings, size)
        set_shape(parameters, shape)
        if moved < settings.converged:
            break
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
) -> None:
    """Fit the part of ``size`` px around the bright spot of each window (n,h,h) of floats, which moved by ``smears``
    (n,2) px during the exposure.

    Fills the corners (n,2) of these parts, and in their px the parameters (n,7), shapes (n,2,2), covariances (n,m,m) of
    the first m parameters and misfits (n,).
    """
    for k in range(len(windows)):
        spot = moments(windows[k])
        room = windows.shape[1] - size
        left = min(max(int(np.rint(spot[2] - 0.5 * (size - 1))), 0), room)
        top = min(max(int(np.rint(spot[3] - 0.5 * (size - 1))), 0), room)
        part = windows[k, top : top + size, left : left + size]
        start_ellipse(moments(part) if room else spot, size, parameters[k])
        misfits[k] = fit_window(part, smears[k], settings, parameters[k], shapes[k], covariances[k])
        corners[k, 0], corners[k, 1] = left, top
