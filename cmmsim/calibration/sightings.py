"""All that both cameras saw of the board, as the adjustment takes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board_detection import BoardView
from cmmsim.geometry.pose import Array

SIDES = ("left", "right")


@dataclass(frozen=True)
class PairView:
    """What one pair of images shows; a side is the board or the reason why there is none."""

    name: str
    left: BoardView | str
    right: BoardView | str

    @property
    def sides(self) -> tuple[BoardView | str, BoardView | str]:
        """Left and right."""
        return self.left, self.right

    @property
    def both(self) -> bool:
        """Whether both cameras see the board."""
        return not isinstance(self.left, str) and not isinstance(self.right, str)

    @property
    def reasons(self) -> str:
        """Why sides are missing; empty when none is."""
        if isinstance(self.left, str) and self.left == self.right:
            return f"both: {self.left}"
        return "; ".join(
            f"{name}: {side}" for name, side in zip(SIDES, self.sides, strict=True) if isinstance(side, str)
        )

    def without(self, side: int, reason: str) -> PairView:
        """The pair with one side (0 left, 1 right) given up."""
        return replace(self, left=reason) if side == 0 else replace(self, right=reason)


@dataclass(frozen=True)
class Sightings:
    """Points seen by one camera in all pairs: view (m,) ascending, point (m,) of the board, pixels (m, 2)."""

    view: NDArray[np.int_]
    point: NDArray[np.int_]
    pixels: Array

    def shifted(self, by: Array) -> Sightings:
        """The sightings with their pixels moved by (m, 2)."""
        return replace(self, pixels=self.pixels + by)


def sightings_of(pairs: Sequence[PairView]) -> tuple[Sightings, Sightings]:
    """Sightings of the left and of the right camera; a pair's place in the list is its view."""
    both = []
    for side in range(2):
        seen = [(k, pair.sides[side]) for k, pair in enumerate(pairs)]
        views = [(k, view) for k, view in seen if not isinstance(view, str)]
        both.append(
            Sightings(
                np.concatenate([np.full(len(v.index), k) for k, v in views]),
                np.concatenate([v.index for _, v in views]),
                np.concatenate([v.pixels for _, v in views]),
            )
        )
    return both[0], both[1]
