"""Inner corners of a chessboard by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array

FINE_WINDOW_SHARE = 0.3  # half window of cornerSubPix over the distance of neighbouring corners


def find_chessboard(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """Corners (rows * columns, 2) px, or None. The sector-based search first, then the older one, refined."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=flags)
    if found:
        return np.asarray(corners, dtype=float).reshape(-1, 2)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    if not found:
        return None
    corners = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    grid = corners.reshape(rows, columns, 2)
    nearest = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
    half = max(2, int(FINE_WINDOW_SHARE * nearest))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    fine = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop)
    return np.asarray(fine, dtype=float).reshape(-1, 2)
