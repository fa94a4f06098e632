"""The drawn board: a bright plate with dark dots or squares, as both renderers or pyrender take it."""

from __future__ import annotations

import numpy as np
import trimesh

from cmmsim.calibration.board import Board
from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene import SUNK, Disc, DiscStack, Mesh, Patch, solid_mesh
from cmmsim.imaging.views import Drawable

MARGIN = 1.0  # of the spacing: rim of the plate beyond its outermost points; a chessboard's outer squares reach there
RIM = 0.35  # of the spacing: bright rim beyond the outer squares of a chessboard
THICKNESS = 0.008  # m
BRIGHT, DARK = 0.86, 0.06  # share of white light sent back
FRONT = np.array([0.0, 0.0, -1.0])  # the front looks against the board's z axis
FRONT.setflags(write=False)


def board_drawable(board: Board, distance: float) -> Drawable:
    """Everything of a board as one body in the board frame, seen from ``distance`` m; the points lie in z = 0."""
    ground, mark = (BRIGHT, DARK) if board.dark else (DARK, BRIGHT)
    marks: list[Patch] = [*(_squares(board, mark) if board.kind == "chessboard" else _dots(board, mark))]
    patches = [*marks, _plate(board, ground)]
    return Drawable(patches, [0] * len(patches), distance)


def plate_corners(board: Board) -> Array:
    """Corners (4,3) of the plate's front, m."""
    points = board.points
    rim = board.spacing * (MARGIN + (RIM if board.kind == "chessboard" else 0.0))
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0) - rim, points[:, :2].max(axis=0) + rim
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def _plate(board: Board, level: float) -> Mesh:
    corners = plate_corners(board)
    size = [*(corners[2, :2] - corners[0, :2]), THICKNESS]
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([*corners[:, :2].mean(axis=0), SUNK + 0.5 * THICKNESS])
    return solid_mesh(mesh, level)


def _dots(board: Board, level: float) -> list[DiscStack]:
    return [DiscStack((Disc(point, FRONT, float(board.radius or 0.0), level),)) for point in board.points]


def _squares(board: Board, level: float) -> list[Mesh]:
    """The dark squares of a chessboard, its outermost ones included."""
    corners = board.spacing * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    places = [
        np.array([column, row, 0.0]) * board.spacing
        for row in range(-1, board.rows)
        for column in range(-1, board.columns)
        if (row + column) % 2 == 0
    ]
    return [Mesh(corners + place, np.array([[0, 1, 2], [0, 2, 3]]), np.full(4, level)) for place in places]
