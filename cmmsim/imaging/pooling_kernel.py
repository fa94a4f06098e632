"""Compiled: drawn cells averaged into the pixels of windows."""

from __future__ import annotations

import numpy as np

from cmmsim.compiled import compiled


@compiled
def mean_of_cells(drawn: np.ndarray, columns: int, supersampling: int, windows: np.ndarray) -> None:
    """Fill windows (n, h, w) float32, 0 to 1, with the means of ``supersampling``² drawn pixels, 0 to 255.

    ``drawn`` holds the cell of each window in reading order, ``columns`` of them a row.
    """
    count, height, width = windows.shape
    share, white = np.float32(1.0 / (supersampling * supersampling)), np.float32(255.0)
    sums = np.empty(width * supersampling, dtype=np.uint32)
    for n in range(count):
        top, left = n // columns * height * supersampling, n % columns * width * supersampling
        for y in range(height):
            sums[:] = 0
            for i in range(supersampling):
                row = drawn[top + y * supersampling + i, left : left + width * supersampling]
                for x in range(len(row)):
                    sums[x] += row[x]
            for x in range(width):
                total = np.uint32(0)
                for i in range(supersampling):
                    total += sums[x * supersampling + i]
                windows[n, y, x] = np.float32(total) * share / white
