"""Compiled: from the light on each pixel to its grey value, see ``noise``."""

from __future__ import annotations

import numpy as np

from cmmsim.compiled import Array, compiled


@compiled
def expose_pixels(
    radiance: Array, normal: Array, figures: Array, sensitivity: Array, offset: Array, grey: Array
) -> None:
    """Fill the grey values (n,) of pixels with this radiance (n,) and a standard normal number each (n,).

    All is float32, grey the camera's own type. figures (6,): electrons at white, full well, variance in the dark (e-²),
    black level, gain, largest grey value; sensitivity and offset (n,) where pixels differ, else empty.
    """
    white_electrons, full_well, dark, black, gain, white = figures
    for k in range(len(radiance)):
        light = radiance[k] * white_electrons
        if len(sensitivity):
            light *= sensitivity[k]
        electrons = min(light, full_well)
        noise = normal[k] * np.sqrt(electrons + dark)
        if len(offset):
            noise += offset[k]
        value = black + gain * (electrons + noise)
        grey[k] = np.rint(min(max(value, np.float32(0.0)), white))
