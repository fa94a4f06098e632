"""Calibration boards: the content of a board file (TOML), and the positions of its points.

The board frame has its origin at the first point. Its x axis points from column to column, its y
axis from row to row, and its z axis away from an observer who looks at the front. All points lie in
z = 0. They are ordered row by row, and along x within a row, as in OpenCV.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from cmmsim.checks import Section, checked, parsed, read_text
from cmmsim.errors import CalibrationError
from cmmsim.geometry.pose import Array

Length = Annotated[float, Field(gt=0.0, le=100.0)]
Count = Annotated[int, Field(ge=3, le=200)]


class Board(Section):
    """Flat board.

    kind     "chessboard", "dots" (rows and columns at right angles) or "asymmetric_dots" (every
             other row shifted)
    columns  points along x: inner corners of a chessboard, or dots in one row
    rows     points along y
    spacing  distance between neighbouring points, m; for asymmetric_dots the distance between
             rows, while dots of the same row are twice as far apart
    radius   radius of the dots, m; not allowed for a chessboard
    dark     True if dots are darker than the board
    """

    model_config = ConfigDict(strict=True)

    kind: Literal["chessboard", "dots", "asymmetric_dots"]
    columns: Count
    rows: Count
    spacing: Length
    radius: Length | None = None
    dark: bool = True

    @model_validator(mode="after")
    def _dots_fit(self) -> Board:
        """Raise ValueError for dots that nearly touch, or for a radius that is missing or extra."""
        if self.kind == "chessboard":
            if self.radius is not None:
                raise ValueError("a chessboard has no dots, remove radius")
        elif self.radius is None:
            raise ValueError(f"radius of the dots (m) is missing, {self.kind} need it")
        elif self.radius > 0.4 * self.nearest:
            raise ValueError(
                f"dots of radius {self.radius:g} m, {self.nearest:g} m from centre to centre, "
                f"nearly touch: the largest radius is {0.4 * self.nearest:.4g} m"
            )
        return self

    @property
    def dot_radius(self) -> float:
        """Radius of the dots, m; 0 for a chessboard."""
        return self.radius or 0.0

    @property
    def nearest(self) -> float:
        """Distance between nearest points, m."""
        return self.spacing * (float(np.sqrt(2.0)) if self.kind == "asymmetric_dots" else 1.0)

    @property
    def points(self) -> Array:
        """Points (rows * columns, 3) in the board frame, m."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        x = 2 * column + row % 2 if self.kind == "asymmetric_dots" else column
        return self.spacing * np.column_stack([x, row, np.zeros_like(row)]).astype(float)

    @property
    def symmetries(self) -> list[NDArray[np.int_]]:
        """Orders (points,) of the board's points that a picture cannot tell apart.

        The first is the order of ``points``. The others follow from half a turn of the board, and
        from quarter turns if it has as many rows as columns. An asymmetric grid with an odd number
        of rows has no others.
        """
        order = np.arange(self.rows * self.columns)
        if self.kind == "asymmetric_dots":
            return [order] if self.rows % 2 else [order, order[::-1]]
        if self.rows != self.columns:
            return [order, order[::-1]]
        grid = order.reshape(self.rows, self.columns)
        return [np.rot90(grid, k).ravel() for k in range(4)]

    def as_toml(self) -> str:
        """Return the board as the text of a board file."""
        lines = [
            f'kind = "{self.kind}"',
            f"columns = {self.columns}",
            f"rows = {self.rows}",
            f"spacing = {self.spacing!r}  # m",
        ]
        if self.radius is not None:
            lines += [f"radius = {self.radius!r}  # m", f"dark = {str(self.dark).lower()}"]
        return "\n".join(lines) + "\n"


def read_board(path: str | Path) -> Board:
    """Read the board of a TOML file.

    Raises CalibrationError for an unknown key, with the valid names, and for an invalid value.
    """
    source = f"board file {path}"
    content = parsed(read_text(path, source, CalibrationError), source, CalibrationError)
    return checked(Board, content, source, CalibrationError)
