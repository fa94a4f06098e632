"""Compiled kernels that draw grey values of one exposure, and means of many; see ``noise``."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled

# Normal noise beyond this number of standard deviations is neglected. Its probability is 2e-9.
REACH = 6.0
# From this standard deviation on, in grey values, rounding is taken to add 1/12 to the variance and
# nothing to the mean. The error of the mean is then below 1e-9.
SMOOTH_DEVIATION = 1.0
SQRT_HALF = math.sqrt(0.5)


@compiled
def expose_pixels(
    radiance: Array,
    normal: Array,
    parameters: Array,
    sensitivity: Array,
    offset: Array,
    grey: Array,
) -> None:
    """Fill the grey values (n,) of pixels in one exposure.

    ``radiance`` (n,) is the light on each pixel, 0 to 1, and ``normal`` (n,) a standard normal
    random number per pixel. ``parameters`` (6,) are electrons at white, full well, variance in the
    dark (e-²), black level, gain, and the largest grey value. ``sensitivity`` and ``offset`` (n,)
    are those of ``FixedPattern``, or empty if pixels do not differ. All arrays are float32, except
    that ``grey`` has the camera's type.
    """
    dark, black, gain, white = parameters[2:]
    for k in range(len(radiance)):
        electrons = electrons_in(k, radiance, parameters, sensitivity)
        # the variance of shot noise equals the mean number of electrons (Poisson distribution)
        noise = normal[k] * np.sqrt(electrons + dark)
        if len(offset):
            noise += offset[k]
        value = black + gain * (electrons + noise)
        grey[k] = np.rint(min(max(value, np.float32(0.0)), white))


@compiled
def average_pixels(
    radiance: Array,
    normal: Array,
    parameters: Array,
    sensitivity: Array,
    offset: Array,
    frames: int,
    grey: Array,
) -> None:
    """Fill the mean grey values (n,), float64, of pixels in ``frames`` independent exposures.

    The means are assumed to be normal. Arguments are those of ``expose_pixels``, with one random
    number per pixel for all exposures together.
    """
    dark, black, gain, white = parameters[2:]
    for k in range(len(radiance)):
        electrons = electrons_in(k, radiance, parameters, sensitivity)
        value = black + gain * (electrons + (offset[k] if len(offset) else np.float32(0.0)))
        mean, variance = moments_of_rounded(value, gain * np.sqrt(electrons + dark), white)
        grey[k] = mean + normal[k] * math.sqrt(variance / frames)


@compiled
def electrons_in(k: int, radiance: Array, parameters: Array, sensitivity: Array) -> float:
    """Return the mean number of electrons that light releases in pixel k, at most the full well."""
    light = radiance[k] * parameters[0]
    if len(sensitivity):
        light *= sensitivity[k]
    return min(light, parameters[1])


@compiled
def moments_of_rounded(mean: float, deviation: float, white: float) -> tuple[float, float]:
    """Return mean and variance of a normal variable, rounded and clipped to 0 to ``white``."""
    if deviation == 0.0 or mean - REACH * deviation > white or mean + REACH * deviation < 0.0:
        return min(max(np.rint(mean), 0.0), white), 0.0
    if deviation < SMOOTH_DEVIATION:
        # with little noise, the steps of rounding matter, so their contributions are summed
        low = max(math.floor(mean - REACH * deviation), 0.0)
        above, square = moments_above(low - mean, deviation, white - low)
        return low + above, max(square - above**2, 0.0)
    # with more noise, only clipping matters: the parts above white and below 0 are subtracted
    over, over_square = moments_above(white - mean, deviation, np.inf)
    under, under_square = moments_above(mean, deviation, np.inf)
    lost = over_square + 2.0 * (white - mean) * over + under_square + 2.0 * mean * under
    return mean + under - over, max(deviation**2 + 1.0 / 12.0 - lost - (under - over) ** 2, 0.0)


@compiled
def moments_above(height: float, deviation: float, most: float) -> tuple[float, float]:
    """Return mean and mean square of the excess of a rounded normal variable over an integer.

    The integer lies ``height`` above the mean of the normal variable, or below it if ``height`` is
    negative. The excess is 0 for values below the integer, and it is limited to ``most``. Its mean
    is a sum over the steps from one integer to the next. Each step counts with the probability that
    the variable lies beyond the step's middle.
    """
    steps = squares = 0.0
    for step in range(math.ceil(min(most, REACH * deviation - height))):
        probability = 0.5 * math.erfc((height + step + 0.5) / deviation * SQRT_HALF)
        steps += probability
        squares += (2.0 * step + 1.0) * probability
    return steps, squares
