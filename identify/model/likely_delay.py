"""Delay of measured motion behind a model's, which shows that clocks differ."""

import numpy as np
from scipy.optimize import minimize_scalar

from identify.arrays import Array
from identify.filtering import interpolated

DELAYS = 50
"""Number of delays of either sign that are tried first."""


def likely_delay(times: Array, model: Array, measured: Array, farthest: float) -> float:
    """Return the delay, s, of measured poses (k, 6) behind those of a model at times (k,).

    It is the delay up to `farthest` with the smallest squared difference, each component in units
    of its spread.
    """
    spread = measured.std(axis=0)
    moving = spread > 0
    scaled = [one[:, moving] / spread[moving] for one in (model, measured)]
    inner = (times > times[0] + farthest) & (times < times[-1] - farthest)

    def apart(delay: float) -> float:
        moved = interpolated(times[inner] - delay, times, scaled[0])
        return float(np.mean((moved - scaled[1][inner]) ** 2))

    coarse = np.linspace(-farthest, farthest, 2 * DELAYS + 1)
    best = coarse[int(np.argmin([apart(delay) for delay in coarse]))]
    step = coarse[1] - coarse[0]
    found = minimize_scalar(apart, bounds=(best - step, best + step), method="bounded")
    return float(found.x)
