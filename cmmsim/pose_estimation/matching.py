"""Which spot of the left image may be the same sticker as which spot of the right image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.triangulation import linear_triangulation

LINE_TOLERANCE_PX = 0.5
NEAREST, FURTHEST = 0.3, 6.0  # m


def epipolar_distance(rig: StereoRig, left: Array, right: Array) -> Array:
    """Distance (n, m) of each right pixel (m, 2) from the epipolar line of each left pixel (n, 2), ideal px."""
    lines = np.column_stack([left, np.ones(len(left))]) @ rig.fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    return np.abs(lines @ np.column_stack([right, np.ones(len(right))]).T)


def candidate_pairs(rig: StereoRig, left: Array, right: Array) -> tuple[NDArray[np.int_], Array]:
    """All pairs (m, 2) of left and right spots that may be one point, and their points (m, 3) in the camera frame.

    Parameters: left (k, 2) and right (l, 2) in ideal px. A spot may appear in several pairs; the known layout decides
    later which of them is true.
    """
    pairs = np.argwhere(epipolar_distance(rig, left, right) < LINE_TOLERANCE_PX)
    points = linear_triangulation(rig, left[pairs[:, 0]], right[pairs[:, 1]])
    near = (points[:, 2] > NEAREST) & (np.linalg.norm(points, axis=1) < FURTHEST)
    return pairs[near], points[near]
