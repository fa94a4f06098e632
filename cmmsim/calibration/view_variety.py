"""How many different places of the board some pictures show: pictures alike tell no more than one of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration_errors import CalibrationError
from cmmsim.geometry.pose import Array

ALIKE_PX = 2.0  # rms distance of the points of two pictures that show the board in one place


def require_variety(views: Sequence[BoardView], orders: Sequence[NDArray[np.int_]], camera: str, fewest: int) -> None:
    """Raise CalibrationError where the views of a camera show fewer than ``fewest`` places of the board.

    orders: the board's symmetries, in any of which a view may be read.
    """
    count = len(different_views(views, orders))
    if count < fewest:
        places = "one place" if count == 1 else f"{count} places"
        raise CalibrationError(
            f"the {len(views)} pictures of the {camera} camera are alike, they show the board in "
            f"{places} only (within {ALIKE_PX:g} px), {fewest} at the least are needed: move and "
            "tilt the board from picture to picture"
        )


def different_views(views: Sequence[BoardView], orders: Sequence[NDArray[np.int_]]) -> list[BoardView]:
    """The views without those that show the board where an earlier one does."""
    found: list[BoardView] = []
    for view in views:
        readings = [view.read_as(order) for order in orders]
        if not any(_distance(reading, other) < ALIKE_PX for reading in readings for other in found):
            found.append(view)
    return found


def _distance(a: BoardView, b: BoardView) -> float:
    """Root mean square distance of the points that both show, px."""
    _, in_a, in_b = np.intersect1d(a.index, b.index, return_indices=True)
    gap: Array = a.pixels[in_a] - b.pixels[in_b]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))) if len(gap) else np.inf
