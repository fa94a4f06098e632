"""Detection of the inner corners of chessboards and ChArUco boards, by OpenCV."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.geometry.pose import Array

# Half the width of cornerSubPix's window, as a fraction of the distance between neighbouring
# corners.
FINE_WINDOW_RATIO = 0.3
# A ChArUco board with fewer detected corners is not accepted.
FEWEST_CORNERS = 4
# Fraction of the margin between marker and edge of the square that is painted over with the marker.
PAINTED = 0.5
# Percentile of the grey values of the square that gives the grey value of the paint.
PAPER_PERCENTILE = 90.0
# Number of fractional binary digits in the coordinates of painted polygons.
SHIFT = 4
# A corner is an outlier if it is farther than this from the pixel that the homography predicts.
OUTLIER_PX = 2.0


def find_chessboard(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """Return the corners (rows * columns, 2) px, or None.

    The sector-based search is tried first, then the older search, whose corners are refined.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=flags)
    if found:
        return np.asarray(corners, dtype=float).reshape(-1, 2)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    if not found:
        return None
    corners = np.asarray(corners, dtype=float).reshape(-1, 2)
    grid = corners.reshape(rows, columns, 2)
    nearest = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
    return _fine(grey, corners, nearest)


def counts_squares(grey: NDArray[np.uint8], columns: int, rows: int) -> bool:
    """Return True if a quick search finds a chessboard of ``columns`` x ``rows`` squares."""
    corners = (columns - 1, rows - 1)
    # OpenCV refuses boards of fewer corners.
    if min(corners) < 3:
        return False
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    return bool(cv2.findChessboardCorners(grey, corners, flags=flags)[0])


def find_charuco(grey: NDArray[np.uint8], board: Board) -> Array | None:
    """Return the corners (rows * columns, 2) px, or None if fewer than FEWEST_CORNERS are found.

    Corners that are not seen are NaN. The pattern of OpenCV before version 4.6 is tried second.
    """
    for legacy in (False, True):
        detector = cv2.aruco.CharucoDetector(board.charuco(legacy))
        corners, index, markers, _ = detector.detectBoard(grey)
        if index is not None and len(index) >= FEWEST_CORNERS:
            seen = np.ravel(index)
            pixels = np.full((board.rows * board.columns, 2), np.nan)
            rough = np.asarray(corners, dtype=float).reshape(-1, 2)
            pixels[seen] = _refined(grey, board, rough, seen, np.reshape(markers, (-1, 4, 2)))
            return pixels
    return None


def _refined(
    grey: NDArray[np.uint8], board: Board, rough: Array, index: Array, outlines: Array
) -> Array:
    """Return refined corners (n, 2) px, from ``rough`` ones of the points ``index`` of a board.

    OpenCV refines corners in windows so small that they exclude the markers. Here the markers with
    ``outlines`` (m, 4, 2) px are painted over, so that the windows can be as large as those of a
    chessboard.
    """
    growth = board.spacing / (board.marker or board.spacing)
    painted = grey.copy()
    for outline in outlines:
        middle = outline.mean(axis=0)
        square = np.rint(middle + growth * (outline - middle)).astype(np.int32)
        inside = np.zeros_like(grey, shape=np.ptp(square, axis=0)[::-1] + 1)
        first = square.min(axis=0)
        cv2.fillConvexPoly(inside, square - first, 1)
        low = np.maximum(first, 0)
        patch = grey[low[1] : first[1] + len(inside), low[0] : first[0] + inside.shape[1]]
        shown = inside[low[1] - first[1] :, low[0] - first[0] :][: patch.shape[0], : patch.shape[1]]
        paper = float(np.percentile(patch[shown > 0], PAPER_PERCENTILE))
        reach = 1.0 + PAINTED * (growth - 1.0)
        fixed = np.rint((middle + reach * (outline - middle)) * 2**SHIFT).astype(np.int32)
        cv2.fillConvexPoly(painted, fixed, (paper,), shift=SHIFT)
    plane = board.points[index, :2]
    homography, _ = cv2.findHomography(plane, rough, cv2.RANSAC, OUTLIER_PX)
    if homography is None:
        return rough
    corners = np.stack([plane, *(plane + step for step in board.spacing * np.eye(2))])
    predicted = cv2.perspectiveTransform(corners.reshape(1, -1, 2), homography).reshape(3, -1, 2)
    nearest = np.linalg.norm(predicted[1:] - predicted[0], axis=2).min()
    return _fine(painted, rough, nearest)


def _fine(grey: NDArray[np.uint8], rough: Array, nearest: float) -> Array:
    """Return corners (n, 2) px refined in windows that suit the distance to the nearest corner."""
    half = max(2, int(FINE_WINDOW_RATIO * nearest))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.array(rough, dtype=np.float32).reshape(-1, 1, 2)
    fine = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), stop)
    return np.asarray(fine, dtype=float).reshape(-1, 2)
