"""Compiled: what a fit of ellipses finds of stickers that nobody draws, in windows of both
images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.detection.fit_kernels import FitSettings
from cmmsim.geometry.camera_kernels import length_of
from cmmsim.geometry.matrix_kernels import factor
from cmmsim.without_images.centre_kernels import fit_covariances


class Ellipses(NamedTuple):
    """Ellipses of m stickers in both images: centres (2,m,2), shapes (2,m,2,2) and smears (2,m,2),
    px, and a mask ``seen`` (2,m) of those seen whole.

    ``noise`` (2,m,6) is unit normal, for centres, shapes, and how thin an ellipse may be. Contrasts
    and grounds (2,m) are grey values.
    """

    centres: Array
    shapes: Array
    smears: Array
    seen: Array
    noise: Array
    contrasts: Array
    grounds: Array


class Windows(NamedTuple):
    """Parts of ``size`` px that are fitted: sides (k,) and the numbers of their stickers (k,),
    first pixels corners (k,2), and whether there is one to be found (k,)."""

    sides: Array
    stickers: Array
    corners: Array
    found: Array
    size: int


class Fits(NamedTuple):
    """Results of k fits: good (k,), centres (k,2) px, shapes (k,2,2) px, and the covariances
    (k,5,5) of both; contrasts and grounds (k,), grey values.
    """

    good: Array
    centres: Array
    shapes: Array
    covariances: Array
    contrasts: Array
    grounds: Array


class Smallest(NamedTuple):
    """Limits for an ellipse: half of its width, px; half of the width at which half of the fits end
    for being too thin, with how softly that sets in; and contrast, grey values.
    """

    radius: float
    thin_px: float
    thin_std_px: float
    contrast: float


@compiled
def nearest_stickers(
    seen: Array, centres: Array, corners: Array, side_px: int, windows: Windows
) -> None:
    """Fill what is fitted in windows of ``side_px`` px with first pixels ``corners`` (2,k,2): parts
    about the sticker nearest to the middle of each, as far as the window goes."""
    at = 0
    slack = side_px - windows.size
    middle = 0.5 * (side_px - 1)
    half = 0.5 * (windows.size - 1)
    for side in range(2):
        for k in range(corners.shape[1]):
            least = np.inf
            corner = corners[side, k]
            windows.stickers[at] = 0
            for n in range(seen.shape[1]):
                x = centres[side, n, 0] - corner[0] - middle
                y = centres[side, n, 1] - corner[1] - middle
                gap = max(abs(x), abs(y))
                if seen[side, n] and gap < least:
                    least = gap
                    windows.stickers[at] = n
            windows.sides[at] = side
            windows.found[at] = least < np.inf
            for i in range(2):
                first = int(np.rint(centres[side, windows.stickers[at], i] - half))
                windows.corners[at, i] = min(max(first, corner[i]), corner[i] + slack)
            at += 1


@compiled
def fit_stickers(
    ellipses: Ellipses, windows: Windows, smallest: Smallest, settings: FitSettings, fits: Fits
) -> None:
    """Fill what is found in windows. What is not good has unit covariances and means nothing."""
    count = len(windows.stickers)
    size = windows.size
    local = np.empty((count, 2))
    shapes = np.empty((count, 2, 2))
    smears = np.empty((count, 2))
    greys = np.empty((2, count))
    known = np.empty((count, 5, 5))
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
        known[:chosen],
    )
    root = np.empty((5, 5))
    off = np.empty(5)
    chosen = 0
    for k in range(count):
        side = windows.sides[k]
        n = windows.stickers[k]
        for i in range(5):
            for j in range(5):
                fits.covariances[k, i, j] = (
                    known[chosen, i, j] if fits.good[k] else 1.0 if i == j else 0.0
                )
                root[i, j] = fits.covariances[k, i, j]
        chosen += fits.good[k]
        factor(root)
        for i in range(5):
            off[i] = 0.0
            for j in range(i + 1):
                off[i] += root[i, j] * ellipses.noise[side, n, j]
        for i in range(2):
            fits.centres[k, i] = ellipses.centres[side, n, i] + off[i]
            for j in range(2):
                fits.shapes[k, i, j] = ellipses.shapes[side, n, i, j] + off[2 + i + j]
