"""Compiled kernels that simulate the results of the ellipse fit without rendering images.

They compute the covariance of an ellipse's centre, and draw random results of fits in windows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.detection.ellipse_fit_kernels import (
    UNKNOWNS,
    FitSettings,
    accumulate,
    light_of_moving,
    mask_ring,
)
from cmmsim.detection.light_kernels import LIT_UNKNOWNS, accumulate_lit
from cmmsim.geometry.camera_kernels import length_of
from cmmsim.geometry.matrix_kernels import factorise, invert_factored


class CentreNoise(NamedTuple):
    """Table of the inverse covariance of an ellipse's centre.

    table     (a, b, c, 3), entries xx, xy, yy of the inverse covariance, px^-2, divided by the
              ellipse's mean half axis m, px; the axes of the table are m and the ovalness p and q,
              which ``statistical_tracker`` explains
    first     (3,), values of m, p and q at which the axes begin
    steps     (3,), steps of the axes
    by_light  (3,); at the fraction ``light`` of full light, the covariance is larger by the factor
              by_light[0] / light² + by_light[1] / light + by_light[2]
    contrast  contrast at full light, grey values
    ring      grey value of the ring at full light, relative to ``black``
    black     grey value without light
    fit_size  side of the fitted part, px
    settings  settings of the fit
    """

    table: Array
    first: Array
    steps: Array
    by_light: Array
    contrast: float
    ring: float
    black: float
    fit_size: int
    settings: FitSettings


@compiled
def fit_covariances(
    centres: Array,
    shapes: Array,
    smears: Array,
    contrasts: Array,
    grounds: Array,
    size: int,
    settings: FitSettings,
    covariances: Array,
) -> None:
    """Fill the covariances (n, m, m) that ``fit_window`` states for the first m parameters.

    The parameters are c_x, c_y, A_xx, A_xy, A_yy, contrast and ground, the grey value of the ring.
    The grey values are those of the model without noise. The n ellipses have centres (n, 2) px
    relative to the first pixels of windows of ``size`` px, shapes (n, 2, 2) px, movements
    ``smears`` (n, 2) px during the exposure, and contrasts and grounds (n,).
    """
    mask = np.empty((size, size), np.bool_)
    window = np.empty((size, size))
    shares = np.empty((size, size))
    derivatives = np.empty((size, size, 5))
    normal = np.empty((UNKNOWNS, UNKNOWNS))
    rhs = np.empty(UNKNOWNS)
    parameters = np.empty(UNKNOWNS)
    for n in range(len(centres)):
        parameters[0] = centres[n, 0]
        parameters[1] = centres[n, 1]
        mask_ring(parameters, shapes[n], settings.ring_reach, mask)
        light_of_moving(parameters, shapes[n], smears[n], settings, shares, derivatives)
        for i in range(size):
            for j in range(size):
                window[i, j] = grounds[n] + contrasts[n] * shares[i, j]
        accumulate(
            window, mask, shares, derivatives, contrasts[n], grounds[n], settings, normal, rhs
        )
        for k in range(UNKNOWNS):
            normal[k, k] += 1e-9  # as in fit_window
        factorise(normal)
        invert_factored(normal, covariances[n])


@compiled
def lit_covariances(
    centres: Array,
    shapes: Array,
    smears: Array,
    contrasts: Array,
    grounds: Array,
    size: int,
    settings: FitSettings,
    covariances: Array,
) -> None:
    """Fill the covariances of fits that also estimate the gradient of the light on a sticker.

    The arguments are those of ``fit_covariances``. The true gradient is zero.
    """
    mask = np.empty((size, size), np.bool_)
    window = np.empty((size, size))
    shares = np.empty((size, size))
    derivatives = np.empty((size, size, 5))
    normal = np.empty((LIT_UNKNOWNS, LIT_UNKNOWNS))
    rhs = np.empty(LIT_UNKNOWNS)
    parameters = np.zeros(LIT_UNKNOWNS)
    for n in range(len(centres)):
        parameters[:2] = centres[n]
        parameters[5] = contrasts[n]
        parameters[6] = grounds[n]
        mask_ring(parameters, shapes[n], settings.ring_reach, mask)
        light_of_moving(parameters, shapes[n], smears[n], settings, shares, derivatives)
        for i in range(size):
            for j in range(size):
                window[i, j] = grounds[n] + contrasts[n] * shares[i, j]
        accumulate_lit(
            window, mask, shares, derivatives, parameters, centres[n], settings, normal, rhs
        )
        factorise(normal)
        invert_factored(normal, covariances[n])


@compiled
def tabulated(
    table: Array,
    first: Array,
    steps: Array,
    by_light: Array,
    xx: float,
    xy: float,
    yy: float,
    light: float,
) -> tuple:
    """Return the covariance xx, xy, yy px² of the centre of an ellipse, from the table.

    xx, xy, yy are the entries of the ellipse's shape, px, and ``light`` is the fraction of full
    light on it. The first four parameters are those of ``CentreNoise``. The table is interpolated
    linearly. Beyond the table, its entries at the edge are used, with the true m.
    """
    mean = 0.5 * (xx + yy)
    a = (mean - first[0]) / steps[0]
    b = (0.5 * (xx - yy) / mean - first[1]) / steps[1]
    c = (xy / mean - first[2]) / steps[2]
    i = min(max(math.floor(a), 0), table.shape[0] - 2)
    j = min(max(math.floor(b), 0), table.shape[1] - 2)
    k = min(max(math.floor(c), 0), table.shape[2] - 2)
    a = min(max(a - i, 0.0), 1.0)
    b = min(max(b - j, 0.0), 1.0)
    c = min(max(c - k, 0.0), 1.0)
    inverse_xx = 0.0
    inverse_xy = 0.0
    inverse_yy = 0.0
    for up in range(2):
        for across in range(2):
            entries = table[i + up, j + across]
            weight = (a if up else 1.0 - a) * (b if across else 1.0 - b)
            lower_weight = weight * (1.0 - c)
            upper_weight = weight * c
            inverse_xx += lower_weight * entries[k, 0] + upper_weight * entries[k + 1, 0]
            inverse_xy += lower_weight * entries[k, 1] + upper_weight * entries[k + 1, 1]
            inverse_yy += lower_weight * entries[k, 2] + upper_weight * entries[k + 1, 2]
    scale = by_light[0] / (light * light) + by_light[1] / light + by_light[2]
    scale /= mean * (inverse_xx * inverse_yy - inverse_xy * inverse_xy)
    return scale * inverse_yy, -scale * inverse_xy, scale * inverse_xx


@compiled
def smeared(noise: CentreNoise, shape: tuple, light: float, centre: tuple, smear: tuple) -> tuple:
    """Return the covariance xx, xy, yy px² of the centre of an ellipse that moves by ``smear`` px.

    It is computed without the table, for the actual position of ``centre`` (x, y) px within its
    pixel. ``smear`` is (x, y), ``shape`` is (xx, xy, yy) px, and ``light`` the fraction of full
    light.
    """
    local = np.empty((1, 2))
    covariances = np.empty((1, 5, 5))
    size = noise.fit_size
    shapes = np.empty((1, 2, 2))
    smears = np.empty((1, 2))
    greys = np.empty((2, 1))
    for i in range(2):
        local[0, i] = centre[i] - np.rint(centre[i] - 0.5 * (size - 1))
        smears[0, i] = smear[i]
        for j in range(2):
            shapes[0, i, j] = shape[i + j]
    greys[0, 0] = noise.contrast * light
    greys[1, 0] = noise.black + noise.ring * light
    fit_covariances(local, shapes, smears, greys[0], greys[1], size, noise.settings, covariances)
    return covariances[0, 0, 0], covariances[0, 0, 1], covariances[0, 1, 1]


@compiled
def contains(centre: float, reach: float, size: int) -> bool:
    """Return True if an ellipse lies inside the fitted part of ``size`` px around its centre.

    Only one axis is tested, along which the ellipse has the ``centre`` and the half extent
    ``reach``, px.
    """
    local = centre - np.rint(centre - 0.5 * (size - 1))
    return local - reach > -0.5 and local + reach < size - 0.5


class Ellipses(NamedTuple):
    """Ellipses of m stickers in both images.

    centres    (2, m, 2), px
    shapes     (2, m, 2, 2), px
    smears     (2, m, 2), movements during the exposure, px
    seen       (2, m), True for stickers that face the camera and are not hidden
    noise      (2, m, 6), standard normal numbers: two for the centre, three for the shape, and one
               for the limit of thin ellipses
    contrasts  (2, m), grey values
    grounds    (2, m), grey values
    """

    centres: Array
    shapes: Array
    smears: Array
    seen: Array
    noise: Array
    contrasts: Array
    grounds: Array


class Windows(NamedTuple):
    """Fitted parts of the images, which are squares of ``size`` px.

    ``sides`` (k,) is 0 for the left and 1 for the right image. ``stickers`` (k,) are the indices of
    their stickers, and ``corners`` (k, 2) their first pixels (x, y). ``found`` (k,) is False for a
    part without a sticker, whose index is then meaningless.
    """

    sides: Array
    stickers: Array
    corners: Array
    found: Array
    size: int


class Fits(NamedTuple):
    """Results of k fits.

    ``good`` (k,) is True for successful fits. Centres (k, 2) and shapes (k, 2, 2), px, have joint
    covariances (k, 5, 5). Contrasts and grounds (k,) are grey values.
    """

    good: Array
    centres: Array
    shapes: Array
    covariances: Array
    contrasts: Array
    grounds: Array


class DetectionLimits(NamedTuple):
    """Limits for the ellipses that can be fitted.

    radius       smallest half axis, px
    thin_px      smaller half axis, px, at which half of the fits fail, because the ellipse is too
                 thin
    thin_std_px  standard deviation of this limit between fits, px
    contrast     smallest contrast, grey values
    """

    radius: float
    thin_px: float
    thin_std_px: float
    contrast: float


@compiled
def nearest_stickers(
    seen: Array, centres: Array, corners: Array, side_px: int, windows: Windows
) -> None:
    """Choose the fitted part of each window, and write it to ``windows``.

    The windows have sides of ``side_px`` px and the first pixels ``corners`` (2, k, 2). A part is
    centred at the sticker nearest to the middle of its window, among those in the mask ``seen``
    (2, m). The part is shifted so that it does not extend beyond the window. The stickers have
    ``centres`` (2, m, 2). The parts of the left image come first.
    """
    part = 0
    slack = side_px - windows.size
    middle = 0.5 * (side_px - 1)
    half = 0.5 * (windows.size - 1)
    for side in range(2):
        for k in range(corners.shape[1]):
            least = np.inf
            corner = corners[side, k]
            windows.stickers[part] = 0
            for n in range(seen.shape[1]):
                x = centres[side, n, 0] - corner[0] - middle
                y = centres[side, n, 1] - corner[1] - middle
                # Windows are square, so the larger of both distances counts.
                distance = max(abs(x), abs(y))
                if seen[side, n] and distance < least:
                    least = distance
                    windows.stickers[part] = n
            windows.sides[part] = side
            windows.found[part] = least < np.inf
            for i in range(2):
                first = int(np.rint(centres[side, windows.stickers[part], i] - half))
                windows.corners[part, i] = min(max(first, corner[i]), corner[i] + slack)
            part += 1


@compiled
def fit_stickers(
    ellipses: Ellipses,
    windows: Windows,
    smallest: DetectionLimits,
    settings: FitSettings,
    fits: Fits,
) -> None:
    """Draw random results of the fits in windows, and write them to ``fits``.

    A fit is successful if the ellipse exceeds the limits ``smallest`` and lies wholly inside the
    fitted part. Results that are not good have unit covariances and meaningless values.
    """
    count = len(windows.stickers)
    size = windows.size
    local = np.empty((count, 2))
    shapes = np.empty((count, 2, 2))
    smears = np.empty((count, 2))
    greys = np.empty((2, count))
    fit_noise = np.empty((count, 5, 5))
    chosen = 0
    for k in range(count):
        side = windows.sides[k]
        n = windows.stickers[k]
        shape = ellipses.shapes[side, n]
        width = 0.5 * (shape[0, 0] + shape[1, 1]) - length_of(
            0.5 * (shape[0, 0] - shape[1, 1]), shape[0, 1]
        )
        good = windows.found[k] and ellipses.contrasts[side, n] >= smallest.contrast
        good = good and width > smallest.radius
        good = good and width > smallest.thin_px + smallest.thin_std_px * ellipses.noise[side, n, 5]
        for i in range(2):
            reach = length_of(shape[i, 0], shape[i, 1])
            local[chosen, i] = ellipses.centres[side, n, i] - windows.corners[k, i]
            good = (
                good and local[chosen, i] - reach > -0.5 and local[chosen, i] + reach < size - 0.5
            )
        fits.contrasts[k] = ellipses.contrasts[side, n]
        fits.grounds[k] = ellipses.grounds[side, n]
        fits.good[k] = good
        if not good:
            continue
        greys[0, chosen] = fits.contrasts[k]
        greys[1, chosen] = fits.grounds[k]
        for i in range(2):
            smears[chosen, i] = ellipses.smears[side, n, i]
            for j in range(2):
                shapes[chosen, i, j] = shape[i, j]
        chosen += 1
    fit_covariances(
        local[:chosen],
        shapes[:chosen],
        smears[:chosen],
        greys[0, :chosen],
        greys[1, :chosen],
        size,
        settings,
        fit_noise[:chosen],
    )
    root = np.empty((5, 5))
    errors = np.empty(5)
    chosen = 0
    for k in range(count):
        side = windows.sides[k]
        n = windows.stickers[k]
        for i in range(5):
            for j in range(5):
                fits.covariances[k, i, j] = (
                    fit_noise[chosen, i, j] if fits.good[k] else 1.0 if i == j else 0.0
                )
                root[i, j] = fits.covariances[k, i, j]
        chosen += fits.good[k]
        # The Cholesky factor of the covariance transforms unit noise to the noise of the fit.
        factorise(root)
        for i in range(5):
            errors[i] = 0.0
            for j in range(i + 1):
                errors[i] += root[i, j] * ellipses.noise[side, n, j]
        for i in range(2):
            fits.centres[k, i] = ellipses.centres[side, n, i] + errors[i]
            for j in range(2):
                fits.shapes[k, i, j] = ellipses.shapes[side, n, i, j] + errors[2 + i + j]
