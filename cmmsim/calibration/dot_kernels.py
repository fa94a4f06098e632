"""Compiled: the window of one dot without what else is in it, see ``detection``."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import Array, compiled
from cmmsim.detection.start_kernels import nth_smallest


@compiled
def isolate_dots(windows: Array, centres: Array, inverses: Array, ground_from: float, reach: float) -> None:
    """Set the pixels of windows (n,h,w) beyond ``reach`` dot radii to the median of those from ``ground_from`` radii to
    there, or to 0 where there are none.

    Parameters: centres (n,2) px of the window; inverses (n,2,2) that carry px to dot radii.
    """
    _, height, width = windows.shape
    distances, around = np.empty((height, width)), np.empty(height * width)
    for n in range(len(windows)):
        count, m = 0, inverses[n]
        for row in range(height):
            for column in range(width):
                x, y = column - centres[n, 0], row - centres[n, 1]
                distance = math.sqrt((m[0, 0] * x + m[0, 1] * y) ** 2 + (m[1, 0] * x + m[1, 1] * y) ** 2)
                distances[row, column] = distance
                if ground_from < distance <= reach:
                    around[count] = windows[n, row, column]
                    count += 1
        ground = 0.0
        if count:
            ground = nth_smallest(around[:count], count // 2)
            if count % 2 == 0:
                ground = 0.5 * (ground + nth_smallest(around[:count], count // 2 - 1))
        for row in range(height):
            for column in range(width):
                if distances[row, column] > reach:
                    windows[n, row, column] = ground
