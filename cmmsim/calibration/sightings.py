"""Views of the board in pairs of image files, and lists of all points that each camera saw."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView, find_board
from cmmsim.errors import CalibrationError
from cmmsim.files.image_files import ImagePair, read_pixels
from cmmsim.geometry.pose import Array

SIDES = ("left", "right")
# Percentile of an image with more than 8 bits that becomes 255. A fixed scale is unsuitable,
# because images of 12-bit cameras use 1/16 of the range of 16 bits.
WHITE_PERCENTILE = 99.9


def read_grey(path: Path) -> NDArray[np.uint8]:
    """Read the grey values (height, width) of an image file.

    A rotation noted in the file's metadata is not applied. Colours are converted to grey. Values of
    more than 8 bits are scaled so that the brightest 0.1 % are white. Raises CalibrationError for a
    file that cannot be read.
    """
    image = read_pixels(path, CalibrationError)
    if image.ndim == 3:
        image = cv2.cvtColor(
            _eight_bit(image), cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        )
    return _eight_bit(image)


def _eight_bit(image: NDArray) -> NDArray[np.uint8]:
    """Return the image with values from 0 to 255. NaN and infinite values become black."""
    if image.dtype == np.uint8:
        return image
    values = np.nan_to_num(image.astype(np.float32), posinf=0.0, neginf=0.0)
    white = max(float(np.percentile(values, WHITE_PERCENTILE)), 1e-9)
    return np.rint(np.clip(values * (255.0 / white), 0.0, 255.0)).astype(np.uint8)


@dataclass(frozen=True)
class PairView:
    """View of the board in one pair of images.

    Each side is the view of one camera, or the reason why that camera has none.
    """

    name: str
    left: BoardView | str
    right: BoardView | str

    @property
    def sides(self) -> tuple[BoardView | str, BoardView | str]:
        """Views of the left and the right camera, or the reasons why they are missing."""
        return self.left, self.right

    @property
    def both(self) -> bool:
        """True if both cameras see the board."""
        return not isinstance(self.left, str) and not isinstance(self.right, str)

    @property
    def reasons(self) -> str:
        """Reasons why views are missing; empty if both cameras have one."""
        if isinstance(self.left, str) and self.left == self.right:
            return f"both: {self.left}"
        return "; ".join(
            f"{name}: {side}"
            for name, side in zip(SIDES, self.sides, strict=True)
            if isinstance(side, str)
        )

    def without(self, side: int, reason: str) -> "PairView":
        """Return the pair with the view of one side (0 left, 1 right) replaced by a reason."""
        return replace(self, left=reason) if side == 0 else replace(self, right=reason)


def view_pairs(
    pairs: Sequence[ImagePair], board: Board, advance: Callable[[], None] = lambda: None
) -> tuple[list[PairView], tuple[int, int]]:
    """Return the views of the board in each pair, and the common size (width, height) px.

    ``advance`` is called after each pair. Raises CalibrationError if there are no pairs, for images
    that cannot be read or differ in size, and for a pair of two equal images.
    """
    if not pairs:
        raise CalibrationError("no pairs of images")
    seen = []
    size = (0, 0)
    for pair in pairs:
        paths = (pair.left, pair.right)
        images = [read_grey(path) for path in paths]
        for path, grey in zip(paths, images, strict=True):
            height, width = grey.shape
            size = (width, height) if path is pairs[0].left else size
            if (width, height) != size:
                raise CalibrationError(
                    f"{path} is {width} x {height} px, but {pairs[0].left} is {size[0]} x "
                    f"{size[1]} px: all images must have the same size, neither rotated nor cropped"
                )
        if np.array_equal(images[0], images[1]):
            raise CalibrationError(
                f"{pair.left} and {pair.right} are the same image: both cameras need their own"
            )
        seen.append(PairView(pair.name, *(find_board(grey, board) for grey in images)))
        advance()
    return seen, size


@dataclass(frozen=True)
class Sightings:
    """All m sightings of board points by one camera.

    ``view`` (m,) are the indices of the views, in ascending order. ``point`` (m,) are the indices
    of the points on the board, and ``pixels`` (m, 2) their pixels.
    """

    view: NDArray[np.int_]
    point: NDArray[np.int_]
    pixels: Array

    def shifted(self, by: Array) -> "Sightings":
        """Return the sightings with their pixels moved by ``by`` (m, 2)."""
        return replace(self, pixels=self.pixels + by)


def sightings_of(pairs: Sequence[PairView]) -> tuple[Sightings, Sightings]:
    """Return the sightings of the left and of the right camera.

    The index of a pair in the list is the index of its view.
    """
    left, right = (views_of(pairs, side) for side in range(2))
    return _joined(left), _joined(right)


def views_of(pairs: Sequence[PairView], side: int) -> dict[int, BoardView]:
    """Return the views of one camera; the keys are the indices of their pairs in the list."""
    return {
        k: view
        for k, view in enumerate(pair.sides[side] for pair in pairs)
        if not isinstance(view, str)
    }


def _joined(views: dict[int, BoardView]) -> Sightings:
    """Join the sightings in all views of one camera; the keys are the indices of the views."""
    return Sightings(
        np.concatenate([np.full(len(view.index), k) for k, view in views.items()]),
        np.concatenate([view.index for view in views.values()]),
        np.concatenate([view.pixels for view in views.values()]),
    )
