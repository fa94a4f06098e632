"""Compiled: where the fit of an ellipse starts, from the ranks and moments of a window's grey values."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import Array, compiled

CORE_SHARE = 0.4  # a pixel with this share of the contrast belongs to the bright spot when the fit starts
SMALLEST_START_PX = 1.2
RANK_STEPS = 256  # a grey value each at 8 bit


@compiled
def nth_smallest(values: Array, n: int) -> float:
    """The value with ``n`` smaller ones (Hoare's selection); reorders ``values``."""
    first, last = 0, len(values) - 1
    if last > 0 and all_alike(values):
        return values[0]
    while first < last:
        pivot, low, high = values[n], first, last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while pivot < values[high]:
                high -= 1
            if low <= high:
                values[low], values[high] = values[high], values[low]
                low, high = low + 1, high - 1
        if high < n:
            first = low
        if n < low:
            last = high
    return values[n]


@compiled
def all_alike(values: Array) -> bool:
    """Whether all values are the same number."""
    different = 0
    for value in values:
        different += value != values[0]
    return different == 0


@compiled
def two_of_rank(window: Array, low_rank: int, high_rank: int) -> tuple:
    """The values of a window (h, w) with ``low_rank`` and with ``high_rank`` smaller ones; all are finite.

    They are counted in even steps from the smallest to the largest, and sorted only within the steps that hold these.
    """
    width, smallest, largest = window.shape[1], window[0, 0], window[0, 0]
    for row in range(window.shape[0]):
        for column in range(width):
            value = window[row, column]
            smallest, largest = value if value < smallest else smallest, value if value > largest else largest
    if smallest == largest:
        return smallest, largest
    scale, counts = (RANK_STEPS - 1) / (largest - smallest), np.zeros(RANK_STEPS, np.int32)
    steps = np.empty(window.shape, np.int32)
    for row in range(window.shape[0]):
        for column in range(width):
            steps[row, column] = int((window[row, column] - smallest) * scale)
            counts[steps[row, column]] += 1
    low, low_before = step_of_rank(counts, low_rank)
    high, high_before = step_of_rank(counts, high_rank)
    found, count = np.empty((2, window.size + 1)), np.zeros(2, np.int64)
    for row in range(window.shape[0]):
        for column in range(width):  # a place is taken by the next one where the value was none to be kept
            found[0, count[0]] = found[1, count[1]] = window[row, column]
            count[0] += steps[row, column] == low
            count[1] += steps[row, column] == high
    return (
        nth_smallest(found[0, : count[0]], low_rank - low_before),
        nth_smallest(found[1, : count[1]], high_rank - high_before),
    )


@compiled
def step_of_rank(counts: Array, rank: int) -> tuple:
    """The step in which the value with ``rank`` smaller ones falls, and how many fall before."""
    step, before = 0, 0
    while before + counts[step] <= rank:
        before += counts[step]
        step += 1
    return step, before


@compiled
def moments(window: Array) -> tuple:
    """Ground, contrast, centroid x, y and spread xx, xy, yy of the bright spot of a window (h, w) of floats."""
    ground, bright = two_of_rank(window, window.size // 3, window.size - 6)
    contrast = max(bright - ground, 1.0)
    area, x, y, xx, xy, yy = 1e-300, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(window.shape[0]):
        for column in range(window.shape[1]):
            if window[row, column] - ground < 0.9 * CORE_SHARE * contrast:
                continue
            share = (window[row, column] - ground) / contrast
            if share > CORE_SHARE:
                share = min(share, 1.0)
                area += share
                x += share * column
                y += share * row
                xx += share * column * column
                xy += share * column * row
                yy += share * row * row
    x, y = x / area, y / area
    return ground, contrast, x, y, xx / area - x * x, xy / area - x * y, yy / area - y * y


@compiled
def bound_radii(xx: float, xy: float, yy: float, lowest: float, highest: float) -> tuple:
    """A symmetric (2,2) matrix with its eigenvalues kept between two limits, given and returned as xx, xy, yy."""
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    large, small = mean + half, mean - half
    if small >= lowest and large <= highest:
        return xx, xy, yy
    bounded_large, bounded_small = min(max(large, lowest), highest), min(max(small, lowest), highest)
    if half == 0.0:
        return bounded_large, 0.0, bounded_large
    scale, middle = (bounded_large - bounded_small) / (2.0 * half), 0.5 * (bounded_large + bounded_small)
    return middle + scale * (xx - mean), scale * xy, middle + scale * (yy - mean)


@compiled
def start_ellipse(spot: tuple, size: int, parameters: Array) -> None:
    """First parameters (7,) from the moments of a window of ``size`` px; a uniform ellipse has spread A A / 4."""
    ground, contrast, x, y, xx, xy, yy = spot
    xx, xy, yy = bound_radii(xx, xy, yy, (0.5 * SMALLEST_START_PX) ** 2, (0.25 * size) ** 2)
    root = math.sqrt(xx * yy - xy * xy)
    scale = 2.0 / math.sqrt(xx + yy + 2.0 * root)  # the root of a matrix M is (M + sqrt(det) 1) / sqrt(...)
    parameters[0], parameters[1] = x, y
    parameters[2], parameters[3], parameters[4] = scale * (xx + root), scale * xy, scale * (yy + root)
    parameters[5], parameters[6] = contrast, ground
