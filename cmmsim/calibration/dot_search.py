"""Rough places of a board's dots in a picture, and their order.

A picture in which one threshold parts all dots from their ground, and in which they lie as a
plane's grid does, is read at once: the four sharpest corners of the dots' convex hull are those of
the board, and a homography names the rest. Any other one is left to OpenCV, which looks at two
dozen thresholds and knows asymmetric grids: thorough, and six times as slow.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.geometry.pose import Array

SMALLEST_AREA_PX = 20.0
LARGEST_AREA = 0.01  # of the image
FIND_SIDE_PX = 1600  # OpenCV first looks in an image of at most this size: faster, and less noise
LARGEST_GRID_GAP = (
    0.3  # of the distance of neighbours, by which a dot may lie off the grid of the four corners
)


def search_dots(bright: NDArray[np.uint8], board: Board) -> Array | None:
    """Rough centres (rows * columns, 2) px of bright dots in the board's order; None where they are
    not found.
    """
    rough = read_at_once(bright, board) if board.kind == "dots" else None
    for side in (FIND_SIDE_PX, max(bright.shape)):
        if rough is None:
            rough = found_by_opencv(bright, board, min(1.0, side / max(bright.shape)))
    return rough


def read_at_once(bright: NDArray[np.uint8], board: Board) -> Array | None:
    """The centres by one threshold, Otsu's; None where that does not show exactly the board's
    grid."""
    points = _bright_spots(bright)
    if len(points) != len(board.points):
        return None
    corners = _sharpest_corners(points)
    last = np.array([board.columns - 1, board.rows - 1], dtype=np.float32)
    grid = last * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    for turn in range(4):
        flat = cv2.getPerspectiveTransform(np.roll(corners, turn, axis=0).astype(np.float32), grid)
        places = cv2.perspectiveTransform(points[None], flat)[0]
        cells = np.rint(places)
        inside = np.all((cells >= 0) & (cells <= last))
        index = (cells[:, 1] * board.columns + cells[:, 0]).astype(int)
        if (
            inside
            and len(set(index)) == len(points)
            and np.abs(places - cells).max() < LARGEST_GRID_GAP
        ):
            return np.asarray(points[np.argsort(index)])
    return None


def _bright_spots(bright: NDArray[np.uint8]) -> Array:
    """Centroids (n,2) px of the bright spots, in an area as a dot may have."""
    _, shown = cv2.threshold(bright, 0.0, 1.0, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    found = []
    for contour in cv2.findContours(shown, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        of = cv2.moments(contour)
        if SMALLEST_AREA_PX <= of["m00"] <= LARGEST_AREA * bright.size:
            x = of["m10"] / of["m00"]
            y = of["m01"] / of["m00"]
            if shown[round(y), round(x)]:
                found.append((x, y))
    return np.array(found).reshape(-1, 2)


def _sharpest_corners(points: Array) -> Array:
    """The four corners (4,2) of the convex hull of points (n,2) with the smallest angles, clockwise
    as one sees them, as the board's are from its front."""
    hull = cv2.convexHull(points.astype(np.float32), clockwise=False)[:, 0].astype(float)
    before, after = (hull - np.roll(hull, step, axis=0) for step in (1, -1))
    cosine = np.sum(before * after, axis=1) / (
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    )
    return np.asarray(hull[np.sort(np.argsort(-cosine)[:4])])


def found_by_opencv(bright: NDArray[np.uint8], board: Board, scale: float) -> Array | None:
    """OpenCV's centres (n, 2) px; it returns (n, 1, 2) up to version 4 and (n, 2) from version 5
    on.
    """
    small = (
        bright
        if scale == 1.0
        else cv2.resize(bright, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )
    small = cv2.GaussianBlur(small, (3, 3), 0.0)
    kind = (
        cv2.CALIB_CB_ASYMMETRIC_GRID
        if board.kind == "asymmetric_dots"
        else cv2.CALIB_CB_SYMMETRIC_GRID
    )
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(
            small, (board.columns, board.rows), flags=flags, blobDetector=_blob_detector(small.size)
        )
        if found:
            rough = np.asarray(centres, dtype=float).reshape(-1, 2)
            return (
                rough + 0.5
            ) / scale - 0.5  # the first pixel's corner, not its middle, stays in place
    return None


def _blob_detector(pixels: int) -> Any:
    opencv: Any = cv2  # its type stubs leave the blob detector out
    options = opencv.SimpleBlobDetector_Params()
    options.filterByColor = True
    options.blobColor = 255
    options.filterByArea = True
    options.minArea = SMALLEST_AREA_PX
    options.maxArea = max(LARGEST_AREA * pixels, 2.0 * SMALLEST_AREA_PX)
    options.filterByConvexity = True
    options.minConvexity = 0.85
    options.filterByInertia = True
    options.minInertiaRatio = 0.08
    options.filterByCircularity = False
    options.minThreshold = 20.0
    options.maxThreshold = 240.0
    options.thresholdStep = 10.0
    options.minDistBetweenBlobs = 3.0
    return opencv.SimpleBlobDetector_create(options)
