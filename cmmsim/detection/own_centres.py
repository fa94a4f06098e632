"""Likely faults of a user's own detector, derived from the centres that it returns.

Each window shows one bright spot. The centroid of its bright pixels is a rough centre. If a change
such as an exchange of x and y brings the centres near the rough centres, the detector likely lacks
this change.
"""

from collections.abc import Iterator

import numpy as np

from cmmsim.geometry.pose import Array

FEWEST = 5  # smallest number of centres that are judged
# Smallest median distance of centres from rough centres that counts as a fault, px. A rough centre
# is accurate to some hundredths of a pixel.
APART_PX = 0.15
# A change is likely if it reduces the median distance at least to this fraction, and below NEAR_PX.
LIKELY = 0.35
NEAR_PX = 1.0


def likely_fault(windows: Array, corners: Array, centres: Array) -> tuple[str, bool]:
    """Return a text on the likely fault of centres (n, 2), and True if the fault is certain.

    The text is empty if no fault is likely. ``windows`` (n, h, h) are grey values with one bright
    spot each, and ``corners`` (n, 2) the first pixels (x, y) of the windows. Centres are in px of
    the whole image. A constant offset is not certain to be a fault.
    """
    if len(centres) < FEWEST:
        return "", False
    rough = corners + _rough_centres(windows)
    distance = _distance(centres, rough)
    if distance < APART_PX:
        return "", False
    near = min(LIKELY * distance, NEAR_PX)
    changes = _changes(windows, corners, centres)
    smallest, fault = min((_distance(changed, rough), text) for text, changed in changes)
    if smallest < near:
        return fault, True
    outside = _outside(windows, corners, centres)
    if 2 * outside > len(centres):
        return f"{outside} of {len(centres)} centres lie outside of their windows", True
    offset = np.median(centres - rough, axis=0)
    if _distance(centres - offset, rough) < near:
        return f"all centres are off by about ({offset[0]:+.2f}, {offset[1]:+.2f}) px", False
    return "", False


def _changes(windows: Array, corners: Array, centres: Array) -> Iterator[tuple[str, Array]]:
    """Yield texts on possible faults, each with the centres (n, 2) without this fault."""
    in_window = centres - corners
    exchanged = centres[:, ::-1]
    last = windows.shape[1] - 1
    yield "they are in px of the windows; add `corners`", corners + centres
    yield "they have x and y exchanged", exchanged
    yield "they have x and y exchanged within the windows", corners + in_window[:, ::-1]
    yield "they are in px of the windows with x and y exchanged", corners + exchanged
    yield (
        "they are the sums of a centre (x, y) in the window and of corners in the order (y, x)",
        centres - corners[:, ::-1] + corners,
    )
    mirrored_x = corners + [last, 0] + in_window * [-1, 1]
    mirrored_y = corners + [0, last] + in_window * [1, -1]
    yield "their x counts from the right edge of the window", mirrored_x
    yield "their y counts from the lower edge of the window", mirrored_y
    yield "the corners are added twice", in_window


def _outside(windows: Array, corners: Array, centres: Array) -> int:
    """Return the number of centres outside of their windows."""
    in_window = centres - corners
    return int(((in_window < -0.5) | (in_window > windows.shape[1] - 0.5)).any(axis=1).sum())


def _distance(centres: Array, rough: Array) -> float:
    """Return the median distance of centres (n, 2) from rough centres (n, 2), px."""
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
