"""Compiled: the grey value of each pixel in one exposure and its mean in many, see ``noise``."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled

# Standard deviations within which noise is followed: 2e-9 of it lie beyond.
REACH = 6.0
# Grey values: with as much noise, rounding adds 1/12 to the variance and 1e-9 to the mean.
SMOOTH = 1.0
SQRT_HALF = math.sqrt(0.5)


@compiled
def expose_pixels(
    radiance: Array, normal: Array, figures: Array, sensitivity: Array, offset: Array, grey: Array
) -> None:
    """Fill the grey values (n,) of pixels with radiance (n,) and a standard normal number each
    (n,).

    All is float32, grey the camera's own type. ``figures`` (6,) are electrons at white, full well,
    variance in the dark (e-²), black level, gain, and the largest grey value. ``sensitivity`` and
    ``offset`` (n,) are empty unless pixels differ.
    """
    dark, black, gain, white = figures[2:]
    for k in range(len(radiance)):
        electrons = electrons_in(k, radiance, figures, sensitivity)
        # Shot noise has the variance of its mean (Poisson); dark noise adds its own.
        noise = normal[k] * np.sqrt(electrons + dark)
        if len(offset):
            noise += offset[k]
        value = black + gain * (electrons + noise)
        grey[k] = np.rint(min(max(value, np.float32(0.0)), white))


@compiled
def average_pixels(
    radiance: Array,
    normal: Array,
    figures: Array,
    sensitivity: Array,
    offset: Array,
    frames: int,
    grey: Array,
) -> None:
    """Fill the means (n,), float64, of the grey values of ``expose_pixels`` in so many exposures.

    They are taken as normal. Parameters are the same, but one standard normal number stands for all
    exposures of a pixel.
    """
    dark, black, gain, white = figures[2:]
    for k in range(len(radiance)):
        electrons = electrons_in(k, radiance, figures, sensitivity)
        value = black + gain * (electrons + (offset[k] if len(offset) else np.float32(0.0)))
        mean, variance = moments_of_rounded(value, gain * np.sqrt(electrons + dark), white)
        grey[k] = mean + normal[k] * math.sqrt(variance / frames)


@compiled
def electrons_in(k: int, radiance: Array, figures: Array, sensitivity: Array) -> float:
    """Return the mean electrons that light sets free in pixel k, at most the full well."""
    light = radiance[k] * figures[0]
    if len(sensitivity):
        light *= sensitivity[k]
    return min(light, figures[1])


@compiled
def moments_of_rounded(mean: float, deviation: float, white: float) -> tuple[float, float]:
    """Return mean and variance of a normal number that is rounded and clipped to 0..white."""
    if deviation == 0.0 or mean - REACH * deviation > white or mean + REACH * deviation < 0.0:
        return min(max(np.rint(mean), 0.0), white), 0.0
    if deviation < SMOOTH:
        # With little noise the steps of rounding show, and are added up one by one.
        low = max(math.floor(mean - REACH * deviation), 0.0)
        above, square = moments_above(low - mean, deviation, white - low)
        return low + above, max(square - above**2, 0.0)
    # With more noise only clipping matters: what lies above white and below black is lost.
    over, over_square = moments_above(white - mean, deviation, np.inf)
    under, under_square = moments_above(mean, deviation, np.inf)
    lost = over_square + 2.0 * (white - mean) * over + under_square + 2.0 * mean * under
    return mean + under - over, max(deviation**2 + 1.0 / 12.0 - lost - (under - over) ** 2, 0.0)


@compiled
def moments_above(height: float, deviation: float, most: float) -> tuple[float, float]:
    """Return the mean and mean square excess of a rounded normal number over a whole number.

    The whole number lies ``height`` above its mean, and the excess is at most ``most``. Each step
    from one number to the next is taken with the probability that the normal number lies beyond its
    middle.
    """
    steps = squares = 0.0
    for step in range(math.ceil(min(most, REACH * deviation - height))):
        taken = 0.5 * math.erfc((height + step + 0.5) / deviation * SQRT_HALF)
        steps += taken
        squares += (2.0 * step + 1.0) * taken
    return steps, squares
