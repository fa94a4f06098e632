"""Detection of a board in a picture: the visible points and their pixels.

Corners of squares are found by OpenCV, see square_detection. A first search for dots at right
angles uses a single threshold. It succeeds if the threshold separates all dots from the background,
and if the dots lie on the perspective image of a grid. The four sharpest corners of the dots'
convex hull are then the corners of the board, and a homography identifies the other dots. If this
search fails, and for asymmetric grids, OpenCV searches for the dots. It tries two dozen thresholds
and is six times as slow.

A fit of a bright ellipse to each dot refines its centre. The result is the centre of the dot's
ellipse in the image, which differs from the image of the dot's centre (see
cmmsim.geometry.disc_image). The fits also measure the radius of the dots, independently of the
board file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.square_detection import counts_squares, find_charuco, find_chessboard
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.detection.tags import find_tags
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise, cut_windows

# Smallest fraction of the points that a view must show, except for ChArUco boards.
FEWEST_MEASURED = 0.7
# Smallest number of measured points of a ChArUco board, which may lie partly outside the picture.
FEWEST_CHARUCO = 6
# A view is rejected if a measured point is farther than this from the pixel that the homography of
# the board predicts. The unit is the distance between neighbouring points.
LARGEST_POINT_GAP = 0.25
# A measured radius contradicts the board file if it differs by more than this fraction. The
# correction of the dots' centres would then be wrong by more than 20 %.
LARGEST_RADIUS_GAP = 0.1

FIT_ITERATIONS = 5
# Radius of the part of the image that is fitted around a dot, in dot radii. The pixels of
# this part beyond GROUND_FROM dot radii belong to the background.
WINDOW_REACH = 2.2
GROUND_FROM = 1.2
# Standard deviations of blur that are tried, on at most PROBED dots.
SPREADS_PX = (0.0, 0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.0)
PROBED = 12
# A fit is rejected if its centre moved by more than this, in dot radii, and by more than 0.5 px.
LARGEST_MOVE = 0.3
# The radius comes from the fits if more than this fraction of them succeed, otherwise from the
# covered area.
FEWEST_FITTED = 0.5
# The area of a dot is measured in its cell, a disc around it. The square that encloses the cell has
# this number of samples along each side.
CELL_SIDE = 41
# The mean of these percentiles of a cell's grey values separates background from dot.
EXTREME_PERCENTILES = (2.0, 98.0)
# The noise of a photograph is unknown. It is set to 5 grey values in all pixels, which then have
# equal weight. A shape with residuals above 25 grey values rms is not an ellipse and is rejected.
PLAIN_NOISE = CameraNoise(
    electrons_at_white=255e4, gain=1e-4, dark_noise=5e4, full_well=1e9, black_level=0.0
)
LIMITS = FitLimits(smallest_contrast=25.0, largest_misfit=25.0)
# Bright spots with a smaller area, or with a larger fraction of the image's area, are not dots.
SMALLEST_AREA_PX = 20.0
LARGEST_AREA = 0.01
# OpenCV first searches an image whose longer side is reduced to this, to save time.
FIND_SIDE_PX = 1600
# The search with a single threshold fails if a dot is farther than this from the grid that the four
# corners define. The unit is the distance between neighbouring dots.
LARGEST_GRID_GAP = 0.3


@dataclass(frozen=True)
class BoardView:
    """View of a board by one camera.

    ``index`` (n,) are the indices of the visible points in ascending order, and ``pixels`` (n, 2)
    their pixels. ``radius`` is the measured radius of the dots, m; None for squares.
    """

    index: NDArray[np.int_]
    pixels: Array
    radius: float | None = None

    def read_as(self, order: NDArray[np.int_]) -> BoardView:
        """Return the view in which point k of the board is taken for point ``order[k]``."""
        indices = order[self.index]
        by_index = np.argsort(indices)
        return replace(self, index=indices[by_index], pixels=self.pixels[by_index])


def find_board(grey: NDArray[np.uint8], board: Board) -> BoardView | str:
    """Return the view of the board in a grey image, or the reason why there is none, as a text."""
    radius: float | None = None
    if board.kind == "chessboard":
        pixels = find_chessboard(grey, board.columns, board.rows)
    elif board.kind == "charuco":
        pixels = find_charuco(grey, board)
    else:
        pixels, radius = find_dots(grey, board) or (None, None)
    if pixels is None and board.kind == "charuco":
        count = len(find_tags(grey, board.markers, "none"))
        return (
            f"no charuco of {board.columns} x {board.rows} corners found, but {count} markers of "
            f"{board.dictionary}"
        )
    if pixels is None:
        squares = board.kind == "chessboard" and counts_squares(grey, board.columns, board.rows)
        hint = ", but one with a corner less in each row and column: count inner corners"
        return f"no {board.kind} of {board.columns} x {board.rows} found{hint if squares else ''}"
    measured = np.isfinite(pixels).all(axis=1)
    fewest = FEWEST_CHARUCO if board.kind == "charuco" else FEWEST_MEASURED * len(pixels)
    if measured.sum() < fewest:
        wrong = radius_differs(radius, board.radius)
        why = f"; dots measure {radius:.3g} m in radius, not {board.radius:g} m" if wrong else ""
        return f"only {measured.sum()} of {len(pixels)} points are sharp and whole{why}"
    return _as_seen_from_the_front(
        board, BoardView(np.flatnonzero(measured), pixels[measured], radius)
    )


def _as_seen_from_the_front(board: Board, view: BoardView) -> BoardView | str:
    """Return the view with its points in the board's order, or the reason why it is rejected.

    A camera sees only the front of a board, so a mirrored order is wrong. Reversing each row
    corrects it. Asymmetric dots in mirrored order are rejected. So are points that lie on one line
    or do not fit a homography.
    """
    grid = np.arange(len(board.points)).reshape(board.rows, board.columns)
    plane = board.points[view.index, :2]
    if len(np.unique(plane[:, 0])) < 2 or len(np.unique(plane[:, 1])) < 2:
        return "its points lie on one line"
    homography, _ = cv2.findHomography(plane, view.pixels)
    if homography is None:
        return "its points lie on one line"
    if np.linalg.det(homography) * (np.append(plane.mean(axis=0), 1.0) @ homography[2]) < 0.0:
        if board.kind == "asymmetric_dots":
            return "the dots were found in mirrored order"
        view = view.read_as(grid[:, ::-1].ravel())
        plane = board.points[view.index, :2]
        homography, _ = cv2.findHomography(plane, view.pixels)
    expected = cv2.perspectiveTransform(plane[None], homography)[0]
    step = np.linalg.norm(
        np.diff(cv2.perspectiveTransform(board.points[None, :2, :2], homography)[0], axis=0)
    )
    farthest = np.linalg.norm(expected - view.pixels, axis=1).max()
    if farthest > LARGEST_POINT_GAP * step:
        return (
            f"points are up to {farthest:.1f} px from the perspective image of the board, so their "
            "order is wrong"
        )
    return view


def radius_differs(measured: float | None, given: float | None) -> bool:
    """Return True if a measured radius contradicts that of the board file.

    Returns False if one of them is missing.
    """
    return (
        measured is not None
        and given is not None
        and bool(abs(measured - given) > LARGEST_RADIUS_GAP * given)
    )


def find_dots(grey: NDArray[np.uint8], board: Board) -> tuple[Array, float] | None:
    """Return the centres (rows * columns, 2) px and the measured radius of the dots, m.

    The centres are in the board's order, and NaN where a fit failed. The result is None if no board
    is found.
    """
    bright = 255 - grey if board.dark else grey
    rough = search_dots(bright, board)
    if rough is None:
        return None
    shapes = _dot_shapes(rough, board)
    centres, ratios = _refine(bright, rough, shapes, board)
    if np.isfinite(ratios).mean() > FEWEST_FITTED:
        return centres, board.dot_radius * float(np.nanmedian(ratios))
    reach = 0.5 * board.nearest
    return centres, reach * covered_radius(bright, rough, shapes * (reach / board.dot_radius))


def _refine(
    bright: NDArray[np.uint8], rough: Array, shapes: Array, board: Board
) -> tuple[Array, Array]:
    """Return fitted centres (n, 2) px, and ratios (n,) of the fitted to the expected radii.

    The dots are expected at ``rough`` centres with ``shapes`` (n, 2, 2). A failed fit gives NaN.
    """
    largest = np.linalg.norm(shapes, axis=2).max(axis=1)
    # the window must not contain neighbouring dots
    reach = min(WINDOW_REACH, board.nearest / board.dot_radius - 1.15)
    sizes = 2 * np.ceil(reach * largest + 1.0).astype(int)
    fine = np.full_like(rough, np.nan)
    ratios = np.full(len(rough), np.nan)
    psf_px = None
    for size in np.unique(sizes)[::-1]:
        chosen = np.flatnonzero(sizes == size)
        corners = np.rint(rough[chosen] - 0.5 * (size - 1)).astype(int)
        windows = cut_windows(bright, corners, int(size))
        isolated = _without_neighbours(windows, rough[chosen] - corners, shapes[chosen], reach)
        psf_px = _point_spread(isolated[:PROBED], corners[:PROBED]) if psf_px is None else psf_px
        fits = fit_ellipses(
            isolated, corners, PLAIN_NOISE, int(size), LIMITS, FIT_ITERATIONS, psf_px
        )
        moved = np.linalg.norm(fits.centres - rough[chosen], axis=1)
        clean = fits.good & (moved < np.maximum(LARGEST_MOVE * largest[chosen], 0.5))
        fine[chosen[clean]] = fits.centres[clean]
        areas = np.abs(np.linalg.det(fits.shapes[clean]) / np.linalg.det(shapes[chosen[clean]]))
        ratios[chosen[clean]] = np.sqrt(areas)
    return fine, ratios


def _point_spread(windows: Array, corners: NDArray[np.int_]) -> float:
    """Return the blur of lens and focus among SPREADS_PX that has the smallest misfit, px."""
    best = SPREADS_PX[0]
    least = np.inf
    # the misfit falls up to the true blur and rises beyond it
    for spread in SPREADS_PX:
        fits = fit_ellipses(
            windows, corners, PLAIN_NOISE, windows.shape[1], LIMITS, FIT_ITERATIONS, spread
        )
        misfit = float(np.median(fits.misfits))
        if not misfit < least:
            break
        best = spread
        least = misfit
    return best


def _dot_shapes(rough: Array, board: Board) -> Array:
    """Return matrices (n, 2, 2) px that map the unit disc to the image of each dot.

    The matrices follow from the homography of the board.
    """
    plane = board.points[:, :2]
    homography, _ = cv2.findHomography(plane, rough)
    moved = [
        cv2.perspectiveTransform((plane + step)[None], homography)[0]
        for step in board.dot_radius * np.eye(2)
    ]
    middle = cv2.perspectiveTransform(plane[None], homography)[0]
    return np.stack([m - middle for m in moved], axis=2)


def _without_neighbours(
    windows: NDArray[np.uint8], centres: Array, shapes: Array, reach: float
) -> Array:
    """Return windows (n, h, h) filled with the background beyond ``reach`` dot radii."""
    # Imported late, because importing numba takes time.
    from cmmsim.detection.start_kernels import isolate_dots

    isolated = np.array(windows, dtype=float)
    isolate_dots(isolated, np.ascontiguousarray(centres), np.linalg.inv(shapes), GROUND_FROM, reach)
    return isolated


def covered_radius(bright: NDArray[np.uint8], centres: Array, steps: Array) -> float:
    """Return the median radius of bright dots, in units of the radius of their cells.

    Centres are (n, 2) px, and ``steps`` (n, 2, 2) px map the unit disc to each dot's cell. The dot
    covers the fraction (mean - ground) / (dot - ground) of its cell. Here, mean is the mean grey
    value of the cell, and ground and dot are the grey values of the background and of the dot. The
    radius is overestimated if a dot is so blurred that its middle is not uniform: by a quarter at
    2.5 px radius and 1 px of blur.
    """
    ticks = np.linspace(-1.0, 1.0, CELL_SIDE)
    within = np.hypot(*np.meshgrid(ticks, ticks)) <= 1.0
    cell = np.stack(np.meshgrid(ticks, ticks), axis=-1)[within]
    samples = (centres[:, None] + cell @ steps.swapaxes(1, 2)).astype(np.float32)
    values = cv2.remap(bright, samples[..., 0], samples[..., 1], cv2.INTER_LINEAR).astype(float)
    middle = np.percentile(values, EXTREME_PERCENTILES, axis=1).mean(axis=0)[:, None]
    ground = np.nanmedian(np.where(values <= middle, values, np.nan), axis=1)
    dot = np.nanmedian(np.where(values >= middle, values, np.nan), axis=1)
    area = (values.mean(axis=1) - ground) / np.maximum(dot - ground, 1.0)
    return float(np.sqrt(max(np.median(area), 0.0)))


def search_dots(bright: NDArray[np.uint8], board: Board) -> Array | None:
    """Return rough centres (rows * columns, 2) px of bright dots in the board's order, or None.

    Otsu's threshold is tried first, except for asymmetric dots. Then OpenCV is tried in a reduced
    image and in the whole image.
    """
    rough = read_at_once(bright, board) if board.kind == "dots" else None
    for scale in sorted({min(1.0, FIND_SIDE_PX / max(bright.shape)), 1.0}):
        if rough is None:
            rough = found_by_opencv(bright, board, scale)
    return rough


def read_at_once(bright: NDArray[np.uint8], board: Board) -> Array | None:
    """Return the dot centres found with Otsu's threshold, in the board's order.

    The result is None unless the bright spots form exactly the board's grid.
    """
    points = _bright_spots(bright)
    if len(points) != len(board.points):
        return None
    corners = _sharpest_corners(points)
    far_corner = np.array([board.columns - 1, board.rows - 1], dtype=np.float32)
    grid = far_corner * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    for turn in range(4):
        homography = cv2.getPerspectiveTransform(
            np.roll(corners, turn, axis=0).astype(np.float32), grid
        )
        grid_points = cv2.perspectiveTransform(points[None], homography)[0]
        cells = np.rint(grid_points)
        inside = np.all((cells >= 0) & (cells <= far_corner))
        index = (cells[:, 1] * board.columns + cells[:, 0]).astype(int)
        if (
            inside
            and len(set(index)) == len(points)
            and np.abs(grid_points - cells).max() < LARGEST_GRID_GAP
        ):
            return np.asarray(points[np.argsort(index)])
    return None


def _bright_spots(bright: NDArray[np.uint8]) -> Array:
    """Return the centroids (n, 2) px of bright spots with an area that is plausible for a dot."""
    _, shown = cv2.threshold(bright, 0.0, 1.0, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    centroids = []
    for contour in cv2.findContours(shown, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        moments = cv2.moments(contour)
        if SMALLEST_AREA_PX <= moments["m00"] <= LARGEST_AREA * bright.size:
            x = moments["m10"] / moments["m00"]
            y = moments["m01"] / moments["m00"]
            # The outlines include those of dark holes in a bright area.
            if shown[round(y), round(x)]:
                centroids.append((x, y))
    return np.array(centroids).reshape(-1, 2)


def _sharpest_corners(points: Array) -> Array:
    """Return the four corners (4, 2) of the points' convex hull that have the smallest angles.

    The corners are in clockwise order in the image, like those of a board seen from the front.
    """
    hull = cv2.convexHull(points.astype(np.float32), clockwise=False)[:, 0].astype(float)
    before, after = (hull - np.roll(hull, step, axis=0) for step in (1, -1))
    cosine = np.sum(before * after, axis=1) / (
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    )
    return np.asarray(hull[np.sort(np.argsort(-cosine)[:4])])


def found_by_opencv(bright: NDArray[np.uint8], board: Board, scale: float) -> Array | None:
    """Return the dot centres (n, 2) that OpenCV finds in a scaled image, or None.

    The centres are in px of the original image. OpenCV before version 5 returns (n, 1, 2).
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
            # scaling leaves the outer corner of the first pixel, (-0.5, -0.5), in its place
            return (rough + 0.5) / scale - 0.5
    return None


def _blob_detector(pixels: int) -> Any:
    """Return OpenCV's detector of bright blobs, for an image of ``pixels`` pixels."""
    opencv: Any = cv2  # the type stubs of OpenCV lack the blob detector
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
