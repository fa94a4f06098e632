"""Compiled kernels for the start values of a fit, from ranks and moments of the grey values.

A further kernel isolates the dots of a calibration board.
"""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled

# A pixel brighter than the ground plus this fraction of the contrast belongs to the bright spot.
CORE_THRESHOLD = 0.4
# Smallest semi-axis with which a fit starts.
SMALLEST_START_PX = 1.2
# Number of histogram bins: one per grey value of 8-bit images.
RANK_BINS = 256


@compiled
def nth_smallest(values: Array, n: int) -> float:
    """Return the value of rank ``n`` (from 0) by Hoare's selection, which reorders ``values``."""
    first = 0
    last = len(values) - 1
    # Windows of equal values are common, and need no selection.
    if last > 0 and all_alike(values):
        return values[0]
    while first < last:
        pivot = values[n]
        low = first
        high = last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while pivot < values[high]:
                high -= 1
            if low <= high:
                values[low], values[high] = values[high], values[low]
                low = low + 1
                high = high - 1
        if high < n:
            first = low
        if n < low:
            last = high
    return values[n]


@compiled
def all_alike(values: Array) -> bool:
    """Return True if all values are the same number."""
    different = 0
    for value in values:
        different += value != values[0]
    return different == 0


@compiled
def two_of_rank(window: Array, low_rank: int, high_rank: int) -> tuple:
    """Return the values of a window (h, w) with the ranks ``low_rank`` and ``high_rank`` (from 0).

    All values must be finite. A histogram with equal bins finds the two bins that contain the
    results, and only the values in these bins are compared with each other.
    """
    width = window.shape[1]
    smallest = window[0, 0]
    largest = window[0, 0]
    for row in range(window.shape[0]):
        for column in range(width):
            value = window[row, column]
            smallest = value if value < smallest else smallest
            largest = value if value > largest else largest
    if smallest == largest:
        return smallest, largest
    scale = (RANK_BINS - 1) / (largest - smallest)
    counts = np.zeros(RANK_BINS, np.int32)
    bins = np.empty(window.shape, np.int32)
    for row in range(window.shape[0]):
        for column in range(width):
            bins[row, column] = int((window[row, column] - smallest) * scale)
            counts[bins[row, column]] += 1
    low, low_before = bin_of_rank(counts, low_rank)
    high, high_before = bin_of_rank(counts, high_rank)
    candidates = np.empty((2, window.size + 1))
    count = np.zeros(2, np.int64)
    for row in range(window.shape[0]):
        # to avoid a branch, every value is stored, and the index advances only for a candidate
        for column in range(width):
            candidates[0, count[0]] = candidates[1, count[1]] = window[row, column]
            count[0] += bins[row, column] == low
            count[1] += bins[row, column] == high
    return (
        nth_smallest(candidates[0, : count[0]], low_rank - low_before),
        nth_smallest(candidates[1, : count[1]], high_rank - high_before),
    )


@compiled
def bin_of_rank(counts: Array, rank: int) -> tuple:
    """Return the bin that contains the value of a rank, and the number of values in lower bins."""
    index = 0
    before = 0
    while before + counts[index] <= rank:
        before += counts[index]
        index += 1
    return index, before


@compiled
def moments(window: Array) -> tuple:
    """Return ground, contrast, centroid x, y and second moments xx, xy, yy of a bright spot.

    Ground and contrast are grey values. The centroid, px, is relative to the first pixel of the
    window. The second moments, px², are about the centroid.
    """
    # Ranks are less sensitive to single noisy pixels than the smallest and largest value.
    ground, bright = two_of_rank(window, window.size // 3, window.size - 6)
    contrast = max(bright - ground, 1.0)
    area = 1e-300
    x = 0.0
    y = 0.0
    xx = 0.0
    xy = 0.0
    yy = 0.0
    for row in range(window.shape[0]):
        for column in range(window.shape[1]):
            # This comparison excludes most pixels without a division.
            if window[row, column] - ground < 0.9 * CORE_THRESHOLD * contrast:
                continue
            share = (window[row, column] - ground) / contrast
            if share > CORE_THRESHOLD:
                share = min(share, 1.0)
                area += share
                x += share * column
                y += share * row
                xx += share * column * column
                xy += share * column * row
                yy += share * row * row
    x = x / area
    y = y / area
    return ground, contrast, x, y, xx / area - x * x, xy / area - x * y, yy / area - y * y


@compiled
def bound_radii(xx: float, xy: float, yy: float, lowest: float, highest: float) -> tuple:
    """Return a symmetric (2, 2) matrix with its eigenvalues limited to a range, as xx, xy, yy."""
    mean = 0.5 * (xx + yy)
    half = math.hypot(0.5 * (xx - yy), xy)
    large = mean + half
    small = mean - half
    if small >= lowest and large <= highest:
        return xx, xy, yy
    bounded_large = min(max(large, lowest), highest)
    bounded_small = min(max(small, lowest), highest)
    if half == 0.0:
        return bounded_large, 0.0, bounded_large
    scale = (bounded_large - bounded_small) / (2.0 * half)
    middle = 0.5 * (bounded_large + bounded_small)
    return middle + scale * (xx - mean), scale * xy, middle + scale * (yy - mean)


@compiled
def start_ellipse(spot: tuple, size: int, parameters: Array) -> None:
    """Fill the first seven parameters from the ``moments`` of a window of ``size`` px.

    A uniform ellipse with the matrix A has the second moments A A / 4.
    """
    ground, contrast, x, y, xx, xy, yy = spot
    xx, xy, yy = bound_radii(xx, xy, yy, (0.5 * SMALLEST_START_PX) ** 2, (0.25 * size) ** 2)
    root = math.sqrt(xx * yy - xy * xy)
    # The square root of a (2, 2) matrix M is (M + sqrt(det) I) / sqrt(trace + 2 sqrt(det)).
    scale = 2.0 / math.sqrt(xx + yy + 2.0 * root)
    parameters[0] = x
    parameters[1] = y
    parameters[2] = scale * (xx + root)
    parameters[3] = scale * xy
    parameters[4] = scale * (yy + root)
    parameters[5] = contrast
    parameters[6] = ground


@compiled
def isolate_dots(
    windows: Array, centres: Array, inverses: Array, ground_from: float, reach: float
) -> None:
    """Set the pixels of windows (n, h, w) beyond ``reach`` dot radii to the ground.

    The ground of a window is the median of its pixels from ``ground_from`` to ``reach`` dot radii,
    or 0 if there are none. Centres (n, 2) are relative to the window, px. ``inverses`` (n, 2, 2)
    map offsets from the centre in px to dot radii.
    """
    _, height, width = windows.shape
    distances = np.empty((height, width))
    ring = np.empty(height * width)
    for n in range(len(windows)):
        count = 0
        m = inverses[n]
        for row in range(height):
            for column in range(width):
                x = column - centres[n, 0]
                y = row - centres[n, 1]
                distance = math.sqrt(
                    (m[0, 0] * x + m[0, 1] * y) ** 2 + (m[1, 0] * x + m[1, 1] * y) ** 2
                )
                distances[row, column] = distance
                if ground_from < distance <= reach:
                    ring[count] = windows[n, row, column]
                    count += 1
        ground = 0.0
        if count:
            ground = nth_smallest(ring[:count], count // 2)
            if count % 2 == 0:
                ground = 0.5 * (ground + nth_smallest(ring[:count], count // 2 - 1))
        for row in range(height):
            for column in range(width):
                if distances[row, column] > reach:
                    windows[n, row, column] = ground
