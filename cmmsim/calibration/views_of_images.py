"""From image files to what they show of the board."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import find_board
from cmmsim.calibration.photographs import ImagePair, read_grey
from cmmsim.calibration.sightings import PairView
from cmmsim.calibration_errors import CalibrationError


def view_pairs(
    pairs: Sequence[ImagePair], board: Board, advance: Callable[[], None] = lambda: None
) -> tuple[list[PairView], tuple[int, int]]:
    """What each pair shows of the board, and the size (width, height) px that all images have.

    advance is called after each pair. Raises CalibrationError for images that cannot be read or differ in size.
    """
    seen, size, first = [], None, None
    for pair in pairs:
        sides = []
        for path in (pair.left, pair.right):
            grey = read_grey(path)
            if size is None:
                size, first = (grey.shape[1], grey.shape[0]), path
            if (grey.shape[1], grey.shape[0]) != size:
                raise CalibrationError(
                    f"{path} is {grey.shape[1]} x {grey.shape[0]} px, {first} {size[0]} x "
                    f"{size[1]}: all images must have one size, unturned and uncropped"
                )
            sides.append(find_board(grey, board))
        seen.append(PairView(pair.name, *sides))
        advance()
    if size is None:
        raise CalibrationError("no pairs of images")
    return seen, size
