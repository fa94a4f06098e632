"""A board in a picture: which of its points are seen, and where.

Corners of a chessboard are those that OpenCV finds. Dots OpenCV finds and orders, and a fit of a
bright ellipse to each makes their centres exact: the centre is that of the dot's ellipse in the
image, not the image of the dot's centre, see cmmsim.geometry.disc_image. The fits also tell the
dots' radius, whatever the board file says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.dot_search import search_dots
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise, cut_windows

FEWEST_SHARE = 0.7  # of the board's points that must be measured
LARGEST_POINT_GAP = (
    0.25  # of the distance of neighbours, by which a point may leave the plane's perspective
)
LARGEST_RADIUS_GAP = (
    0.1  # of a dot's radius, by which the measured one may differ: more costs its correction 20 %
)
FINE_WINDOW_SHARE = 0.3  # half window of cornerSubPix over the distance of neighbouring corners

FIT_ITERATIONS = 5
WINDOW_REACH = 2.2  # dot radii around the centre that are looked at
GROUND_FROM = 1.2  # dot radii from which the ground is taken
SPREADS_PX = (0.0, 0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.0)  # blurs that are tried, sigma
PROBED = 12  # dots on which they are tried
LARGEST_MOVE = (
    0.3  # a fit that ends farther from OpenCV's centre, in dot radii, has caught something else
)
# of the dots whose fits tell their radius; where fewer succeed, the area they cover tells it
FITTED_SHARE = 0.5
CELL_SIDE = 41  # samples along each side of the square around a dot, whose area is measured
EXTREMES = (2.0, 98.0)  # percentiles of a cell whose middle parts ground from dot
# A photograph's noise is not known and its edges are blurred: all grey values count alike, and the
# limit only refuses what is no ellipse at all (residuals of 25 grey values rms).
PLAIN_NOISE = CameraNoise(
    electrons_at_white=255e4, gain=1e-4, dark_noise=5e4, full_well=1e9, black_level=0.0
)
LIMITS = FitLimits(smallest_contrast=25.0, largest_misfit=25.0)


@dataclass(frozen=True)
class BoardView:
    """View of a board by one camera: index (n,) of the points, their pixels (n, 2), and the radius
    of its dots, m.
    """

    index: NDArray[np.int_]
    pixels: Array
    radius: float | None = None

    def read_as(self, order: NDArray[np.int_]) -> BoardView:
        """The same view with its points renamed by one of the board's symmetries."""
        renamed = order[self.index]
        by_index = np.argsort(renamed)
        return replace(self, index=renamed[by_index], pixels=self.pixels[by_index])


def find_board(grey: NDArray[np.uint8], board: Board) -> BoardView | str:
    """The board in one grey image, or in words why not."""
    radius: float | None = None
    if board.kind == "chessboard":
        found = find_chessboard(grey, board.columns, board.rows)
    else:
        found, radius = find_dots(grey, board) or (None, None)
    if found is None:
        return f"no {board.kind} of {board.columns} x {board.rows} found"
    measured = np.isfinite(found).all(axis=1)
    if measured.sum() < FEWEST_SHARE * len(found):
        other = radius_differs(radius, board.radius)
        why = f", its dots measure {radius:.3g} m in radius, not {board.radius:g}" if other else ""
        return f"only {measured.sum()} of {len(found)} points are sharp and whole{why}"
    return _as_seen_from_the_front(
        board, BoardView(np.flatnonzero(measured), found[measured], radius)
    )


def _as_seen_from_the_front(board: Board, view: BoardView) -> BoardView | str:
    """The view with its rows turned round if it was read mirrored: a board is seen from its front
    only.
    """
    grid = np.arange(len(board.points)).reshape(board.rows, board.columns)
    plane = board.points[view.index, :2]
    flat, _ = cv2.findHomography(plane, view.pixels)
    if flat is None:
        return "its points lie on one line"
    if np.linalg.det(flat) * (np.append(plane.mean(axis=0), 1.0) @ flat[2]) < 0.0:
        if board.kind == "asymmetric_dots":
            return "the dots were found in mirrored order"
        view = view.read_as(grid[:, ::-1].ravel())
        plane = board.points[view.index, :2]
        flat, _ = cv2.findHomography(plane, view.pixels)
    expected = cv2.perspectiveTransform(plane[None], flat)[0]
    step = np.linalg.norm(
        np.diff(cv2.perspectiveTransform(board.points[None, :2, :2], flat)[0], axis=0)
    )
    gap = np.linalg.norm(expected - view.pixels, axis=1).max()
    if gap > LARGEST_POINT_GAP * step:
        return f"points leave the plane by up to {gap:.1f} px: not in the board's order"
    return view


def radius_differs(measured: float | None, given: float | None) -> bool:
    """Tell whether a measured radius contradicts a given one; not where either is missing."""
    return (
        measured is not None
        and given is not None
        and bool(abs(measured - given) > LARGEST_RADIUS_GAP * given)
    )


def find_chessboard(grey: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """Corners (rows * columns, 2) px, or None. The sector-based search first, then the older one,
    refined.
    """
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


def find_dots(grey: NDArray[np.uint8], board: Board) -> tuple[Array, float] | None:
    """Dot centres (rows * columns, 2) px in the board's order, NaN where a dot is no clean ellipse,
    and the dots' measured radius, m; None: no board."""
    bright = 255 - grey if board.dark else grey
    rough = search_dots(bright, board)
    if rough is None:
        return None
    shapes = _dot_shapes(rough, board)
    centres, ratios = _refine(bright, rough, shapes, board)
    if np.isfinite(ratios).mean() > FITTED_SHARE:
        return centres, board.dot_radius * float(np.nanmedian(ratios))
    reach = 0.5 * board.nearest
    return centres, reach * covered_radius(bright, rough, shapes * (reach / board.dot_radius))


def _refine(
    bright: NDArray[np.uint8], rough: Array, shapes: Array, board: Board
) -> tuple[Array, Array]:
    """Fitted centres (n, 2), and fitted over expected radii (n,); dots that need windows of one
    size are fitted together."""
    largest = np.linalg.norm(shapes, axis=2).max(axis=1)
    reach = min(WINDOW_REACH, board.nearest / board.dot_radius - 1.15)  # neighbours stay outside
    sizes = 2 * np.ceil(reach * largest + 1.0).astype(int)
    fine = np.full_like(rough, np.nan)
    ratios = np.full(len(rough), np.nan)
    spread = None
    for size in np.unique(sizes)[::-1]:
        chosen = np.flatnonzero(sizes == size)
        corners = np.rint(rough[chosen] - 0.5 * (size - 1)).astype(int)
        windows = cut_windows(bright, corners, int(size))
        alone = _without_neighbours(windows, rough[chosen] - corners, shapes[chosen], reach)
        spread = _point_spread(alone[:PROBED], corners[:PROBED]) if spread is None else spread
        fits = fit_ellipses(alone, corners, PLAIN_NOISE, int(size), LIMITS, FIT_ITERATIONS, spread)
        moved = np.linalg.norm(fits.centres - rough[chosen], axis=1)
        clean = fits.good & (moved < np.maximum(LARGEST_MOVE * largest[chosen], 0.5))
        fine[chosen[clean]] = fits.centres[clean]
        areas = np.abs(np.linalg.det(fits.shapes[clean]) / np.linalg.det(shapes[chosen[clean]]))
        ratios[chosen[clean]] = np.sqrt(areas)
    return fine, ratios


def _point_spread(windows: Array, corners: NDArray[np.int_]) -> float:
    """Sigma in px of the Gaussian blur with which ellipses fit these windows best: that of lens and
    focus together.
    """
    best = SPREADS_PX[0]
    least = np.inf
    # the misfit has one minimum: it falls towards the true blur and rises from there on
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
    """Matrices (n,2,2) px that carry the unit disc to each dot, by the perspective of the whole
    board.
    """
    plane = board.points[:, :2]
    flat, _ = cv2.findHomography(plane, rough)
    moved = [
        cv2.perspectiveTransform((plane + step)[None], flat)[0]
        for step in board.dot_radius * np.eye(2)
    ]
    middle = cv2.perspectiveTransform(plane[None], flat)[0]
    return np.stack([m - middle for m in moved], axis=2)


def _without_neighbours(
    windows: NDArray[np.uint8], centres: Array, shapes: Array, reach: float
) -> Array:
    """Windows (n,h,h) whose pixels beyond ``reach`` dot radii are set to the ground around the
    dot."""
    from cmmsim.detection.start_kernels import (
        isolate_dots,
    )  # compiles, so it is loaded where it is first needed

    alone = np.array(windows, dtype=float)
    isolate_dots(alone, np.ascontiguousarray(centres), np.linalg.inv(shapes), GROUND_FROM, reach)
    return alone


def covered_radius(bright: NDArray[np.uint8], centres: Array, steps: Array) -> float:
    """Median radius of bright dots in units of the reach of the cells: half the distance to the
    nearest neighbour.

    Parameters: image; centres (n,2) px; steps (n,2,2) px that carry the unit disc to each dot's
    cell. In each cell the grey values' share of the step from ground to dot adds up to the dot's
    area. Dots that blur leaves without a level top seem larger: of 2.5 px radius, blurred by 1 px,
    by a quarter.
    """
    ticks = np.linspace(-1.0, 1.0, CELL_SIDE)
    within = np.hypot(*np.meshgrid(ticks, ticks)) <= 1.0
    cell = np.stack(np.meshgrid(ticks, ticks), axis=-1)[within]
    places = (centres[:, None] + cell @ steps.swapaxes(1, 2)).astype(np.float32)
    values = cv2.remap(bright, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(float)
    middle = np.percentile(values, EXTREMES, axis=1).mean(axis=0)[:, None]
    ground = np.nanmedian(np.where(values <= middle, values, np.nan), axis=1)
    dot = np.nanmedian(np.where(values >= middle, values, np.nan), axis=1)
    area = (values.mean(axis=1) - ground) / np.maximum(dot - ground, 1.0)
    return float(np.sqrt(max(np.median(area), 0.0)))
