"""A board in a picture: which of its points are seen, and where."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.chessboard_detection import find_chessboard
from cmmsim.calibration.dot_detection import find_dots
from cmmsim.calibration.dot_radius import differs
from cmmsim.geometry.pose import Array

FEWEST_SHARE = 0.7  # of the board's points that must be measured
LARGEST_GAP = 0.25  # of the distance of neighbours, by which a point may leave the plane's perspective


@dataclass(frozen=True)
class BoardView:
    """What one camera sees of a board: index (n,) of the points, their pixels (n, 2), the radius of its dots, m."""

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
    found, radius = _points(grey, board)
    if found is None:
        return f"no {board.kind} of {board.columns} x {board.rows} found"
    measured = np.isfinite(found).all(axis=1)
    if measured.sum() < FEWEST_SHARE * len(found):
        size = f", its dots measure {radius:.3g} m in radius, not {board.radius:g}" * differs(radius, board.radius)
        return f"only {measured.sum()} of {len(found)} points are sharp and whole{size}"
    return _as_seen_from_the_front(board, BoardView(np.flatnonzero(measured), found[measured], radius))


def _points(grey: NDArray[np.uint8], board: Board) -> tuple[Array | None, float | None]:
    """Points (rows * columns, 2) px, NaN where one is not measured, and the radius of dots, m; None where not found."""
    if board.kind == "chessboard":
        return find_chessboard(grey, board.columns, board.rows), None
    return find_dots(grey, board) or (None, None)


def _as_seen_from_the_front(board: Board, view: BoardView) -> BoardView | str:
    """The view with its rows turned round if it was read mirrored: a board is seen from its front only."""
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
    step = np.linalg.norm(np.diff(cv2.perspectiveTransform(board.points[None, :2, :2], flat)[0], axis=0))
    gap = np.linalg.norm(expected - view.pixels, axis=1).max()
    if gap > LARGEST_GAP * step:
        return f"points leave the plane by up to {gap:.1f} px: not in the board's order"
    return view
