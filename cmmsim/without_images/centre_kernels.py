"""Compiled: how well the fit of an ellipse would know its centre."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.detection.fit_kernels import (
    UNKNOWNS,
    FitSettings,
    accumulate,
    light_of_moving,
    mask_ring,
)
from cmmsim.geometry.matrix_kernels import factor, invert_factored


class CentreNoise(NamedTuple):
    """Inverse covariance xx, xy, yy of a centre over the ellipse's mean half axis m, by m and its
    ovalness p, q (a,b,c,3), from ``first`` (3,) on in ``steps`` (3,); by_light (3,): of 1 / light²,
    1 / light and 1, whose sum is the growth of the covariance in a share of light. contrast, ring
    and black: grey values of full light; fit_size px and settings of the fit."""

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
    """Fill covariances (n,m,m) of the first m parameters that ``fit_window`` would state of n
    ellipses that are as its model says: centres (n,2) in px of parts of ``size`` px, shapes
    (n,2,2), smears (n,2) px, contrasts and grounds (n,)."""
    mask = np.empty((size, size), np.bool_)
    window = np.empty((size, size))
    shares = np.empty((size, size))
    derivatives = np.empty((size, size, 5))
    normal = np.empty((UNKNOWNS, UNKNOWNS))
    right = np.empty(UNKNOWNS)
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
            window, mask, shares, derivatives, contrasts[n], grounds[n], settings, normal, right
        )
        for k in range(UNKNOWNS):
            normal[k, k] += 1e-9  # as the fit does
        factor(normal)
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
    """Covariance xx, xy, yy px² of the centre of an ellipse, whose shape is given, linear between
    the table's entries; first four parameters as of ``CentreNoise``."""
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
    found_xx = 0.0
    found_xy = 0.0
    found_yy = 0.0
    for up in range(2):
        for across in range(2):
            entries = table[i + up, j + across]
            weight = (a if up else 1.0 - a) * (b if across else 1.0 - b)
            near = weight * (1.0 - c)
            far = weight * c
            found_xx += near * entries[k, 0] + far * entries[k + 1, 0]
            found_xy += near * entries[k, 1] + far * entries[k + 1, 1]
            found_yy += near * entries[k, 2] + far * entries[k + 1, 2]
    scale = by_light[0] / (light * light) + by_light[1] / light + by_light[2]
    scale /= mean * (found_xx * found_yy - found_xy * found_xy)
    return scale * found_yy, -scale * found_xy, scale * found_xx


@compiled
def smeared(noise: CentreNoise, shape: tuple, light: float, centre: tuple, smear: tuple) -> tuple:
    """Covariance xx, xy, yy px² of the centre of an ellipse that moves by ``smear`` px, at its own
    place.
    """
    local = np.empty((1, 2))
    found = np.empty((1, 5, 5))
    size = noise.fit_size
    one = np.empty((1, 2, 2))
    moved = np.empty((1, 2))
    greys = np.empty((2, 1))
    for i in range(2):
        local[0, i] = centre[i] - np.rint(centre[i] - 0.5 * (size - 1))
        moved[0, i] = smear[i]
        for j in range(2):
            one[0, i, j] = shape[i + j]
    greys[0, 0] = noise.contrast * light
    greys[1, 0] = noise.black + noise.ring * light
    fit_covariances(local, one, moved, greys[0], greys[1], size, noise.settings, found)
    return found[0, 0, 0], found[0, 0, 1], found[0, 1, 1]


@compiled
def holds(centre: float, reach: float, size: int) -> bool:
    """Tell whether what reaches so far about ``centre``, px along one axis, lies in the part of
    ``size`` px fitted about it.
    """
    local = centre - np.rint(centre - 0.5 * (size - 1))
    return local - reach > -0.5 and local + reach < size - 0.5
