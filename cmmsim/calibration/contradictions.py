"""What the pictures say against the board file and the folders they were given with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration.dot_radius import differs
from cmmsim.calibration.sightings import PairView
from cmmsim.calibration.state import RigState
from cmmsim.geometry.pose import apply, invert

BOARD_SIDES = 0.01, 5.0  # m, smallest and largest longer side of a board that is hardly a wrong unit
LARGEST_UNUSED = 1.0 / 3.0  # of the pairs
LEFTWARD = 0.5  # of the baseline, by which the right camera may stand on the left of the left one


def contradictions(board: Board, state: RigState, pairs: Sequence[PairView]) -> list[str]:
    """One line each: dots of another size, folders that seem swapped, lengths that seem no metres, many pairs not used.

    state: as adjusted; pairs: all of them, with the reasons of those that are not used.
    """
    return [*_dot_radius(board, pairs), *_swapped(state), *_units(board, state), *_unused(board, pairs)]


def _dot_radius(board: Board, pairs: Sequence[PairView]) -> list[str]:
    radii = [
        view.radius for pair in pairs for view in pair.sides if isinstance(view, BoardView) and view.radius is not None
    ]
    measured = float(np.median(radii)) if radii else None
    if not differs(measured, board.radius):
        return []
    return [
        f"the board file gives dots of radius {board.radius:g} m, in the pictures they measure {measured:.4g} m "
        f"where their spacing is {board.spacing:g} m: correct the one that is wrong, the dots' centres rest on it"
    ]


def _swapped(state: RigState) -> list[str]:
    eye = invert(state.right_from_left)[:3, 3]
    if eye[0] >= -LEFTWARD * np.linalg.norm(eye):
        return []
    place = ", ".join(f"{value:.3g}" for value in eye)
    return [
        f"the right camera stands on the left of the left one, at ({place}) m in its axes: if that is not so, swap "
        "the folders LEFT and RIGHT"
    ]


def _units(board: Board, state: RigState) -> list[str]:
    width, height = np.ptp(board.points[:, :2], axis=0)
    if BOARD_SIDES[0] <= max(width, height) <= BOARD_SIDES[1]:
        return []
    middle = board.points.mean(axis=0)
    distance = np.median([np.linalg.norm(apply(pose, middle)) for pose in state.left_from_boards])
    baseline = np.linalg.norm(state.right_from_left[:3, 3])
    return [
        f"a board of {width:.3g} x {height:.3g} m, seen from {distance:.3g} m by cameras {baseline:.3g} m apart: "
        "the board file gives lengths in m, are these other units?"
    ]


def _unused(board: Board, pairs: Sequence[PairView]) -> list[str]:
    unused = [pair for pair in pairs if not pair.both]
    if len(unused) <= LARGEST_UNUSED * len(pairs):
        return []
    return [
        f"{len(unused)} of {len(pairs)} pairs are not used, the first is {unused[0].name} ({unused[0].reasons}): "
        f"has the board {board.columns} columns and {board.rows} rows as its file says?"
    ]
