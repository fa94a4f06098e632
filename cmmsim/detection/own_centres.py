"""Likely faults of a user's own detector, found from the centres that it returns.

Each window shows one bright spot, whose rough centre is the centroid of its bright pixels. If the
centres are far from it, but near it after a change such as exchanged axes, this change is the
likely fault.
"""

from collections.abc import Iterator

import numpy as np

from cmmsim.geometry.pose import Array

FEWEST = 5  # smallest number of centres that are judged
# Smallest median distance of centres from rough centres that counts as a fault, px. A rough centre
# is accurate to some hundredths of a pixel.
APART_PX = 0.15
# Largest ratio of the median distance after a change to that before, at which the change is likely.
LIKELY = 0.35
NEAR_PX = 1.0  # largest median distance after this change


def likely_fault(windows: Array, corners: Array, centres: Array) -> tuple[str, bool]:
    """Return what is likely wrong with centres (n, 2), or an empty text, and whether it is certain.

    windows (n, h, h): grey values with one bright spot each. corners (n, 2): first pixels of the
    windows. Centres are in px of the whole image. A constant offset is not certain to be a fault.
    """
    if len(centres) < FEWEST:
        return "", False
    rough = corners + _rough_centres(windows)
    apart = _distance(centres, rough)
    if apart < APART_PX:
        return "", False
    changed = [(_distance(one, rough), said) for said, one in _changes(windows, corners, centres)]
    least, said = min(changed)
    if least < min(LIKELY * apart, NEAR_PX):
        return said, True
    outside = _outside(windows, corners, centres)
    if 2 * outside > len(centres):
        return f"{outside} of {len(centres)} centres lie outside of their windows", True
    offset = np.median(centres - rough, axis=0)
    if _distance(centres - offset, rough) < min(LIKELY * apart, NEAR_PX):
        return f"all centres are off by about ({offset[0]:+.2f}, {offset[1]:+.2f}) px", False
    return "", False


def _changes(windows: Array, corners: Array, centres: Array) -> Iterator[tuple[str, Array]]:
    """Yield texts on possible faults, each with the centres (n, 2) without this fault."""
    own = centres - corners
    turned = centres[:, ::-1]
    last = windows.shape[1] - 1
    yield "they are in px of the windows; add `corners`", corners + centres
    yield "they have x and y exchanged", turned
    yield "they have x and y exchanged within the windows", corners + own[:, ::-1]
    yield "they are in px of the windows with x and y exchanged", corners + turned
    yield (
        "they are the sums of a centre (x, y) in the window and of corners in the order (y, x)",
        centres - corners[:, ::-1] + corners,
    )
    yield "their x counts from the right edge of the window", corners + [last, 0] + own * [-1, 1]
    yield "their y counts from the lower edge of the window", corners + [0, last] + own * [1, -1]
    yield "the corners are added twice", own


def _outside(windows: Array, corners: Array, centres: Array) -> int:
    """Return the number of centres outside of their windows."""
    own = centres - corners
    return int(((own < -0.5) | (own > windows.shape[1] - 0.5)).any(axis=1).sum())


def _distance(centres: Array, rough: Array) -> float:
    return float(np.median(np.linalg.norm(centres - rough, axis=1)))


def _rough_centres(windows: Array) -> Array:
    """Return the centroids (n, 2) of the grey values above half of the contrast, px."""
    grey = np.asarray(windows, dtype=float)
    flat = grey.reshape(len(grey), -1)
    middle = 0.5 * (np.median(flat, axis=1) + flat.max(axis=1))
    weights = np.clip(grey - middle[:, None, None], 0.0, None)
    total = np.maximum(weights.sum(axis=(1, 2)), 1e-9)
    ticks = np.arange(grey.shape[1])
    x = weights.sum(axis=1) @ ticks
    y = weights.sum(axis=2) @ ticks
    return np.stack([x, y], axis=1) / total[:, None]
