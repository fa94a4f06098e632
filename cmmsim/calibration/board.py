"""Calibration boards: the content of a board file (TOML), and the positions of a board's points.

The board frame has its origin at the first point. Its x axis points from column to column, its y
axis from row to row, and its z axis away from an observer who looks at the front. All points lie in
z = 0. They are ordered row by row, and along x within a row, as in OpenCV.

The points of a chessboard and of a ChArUco board are the inner corners of their squares. Those of
the other boards are the centres of their dots. A ChArUco board has a marker in each bright square.
The markers identify the corners even if a part of the board lies outside of the picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from cmmsim.checks import Section, checked, parsed, read_text
from cmmsim.detection.tags import tag_dictionary
from cmmsim.errors import CalibrationError
from cmmsim.geometry.pose import Array

Length = Annotated[float, Field(gt=0.0, le=100.0)]
Count = Annotated[int, Field(ge=3, le=200)]


class Board(Section):
    """Flat board.

    kind        "chessboard", "charuco", "dots" (rows and columns at right angles) or
                "asymmetric_dots" (every other row shifted)
    columns     points along x: inner corners, one less than squares, or dots in one row
    rows        points along y
    spacing     distance between neighbouring points, m; for asymmetric_dots the distance between
                rows, while dots of the same row are twice as far apart
    radius      radius of the dots, m; only for dots
    dark        True if dots are darker than the board, the default; only for dots
    marker      side of the markers with their dark border, m; only for charuco
    dictionary  OpenCV's name of the markers' dictionary, such as "5X5_100" or "APRILTAG_36h11";
                only for charuco
    """

    model_config = ConfigDict(strict=True)

    kind: Literal["chessboard", "charuco", "dots", "asymmetric_dots"]
    columns: Count
    rows: Count
    spacing: Length
    radius: Length | None = None
    dark: bool = True
    marker: Length | None = None
    dictionary: str | None = None

    @model_validator(mode="after")
    def _markers_fit(self) -> Board:
        """Raise ValueError for markers that are missing, extra, too large or too many."""
        given = (self.marker, self.dictionary)
        if self.kind != "charuco":
            if given != (None, None):
                raise ValueError(f"{self.kind} have no markers; remove marker and dictionary")
            return self
        if self.marker is None or self.dictionary is None:
            raise ValueError("marker (side, m) or dictionary is missing, charuco needs both")
        if self.marker >= self.spacing:
            raise ValueError(
                f"markers of {self.marker:g} m do not fit into squares of {self.spacing:g} m"
            )
        count = (self.rows + 1) * (self.columns + 1) // 2
        if count > (most := len(self.markers.bytesList)):
            raise ValueError(
                f"{self.columns + 1} x {self.rows + 1} squares have {count} markers, but the "
                f"dictionary {self.dictionary} has {most}"
            )
        return self

    @model_validator(mode="after")
    def _dots_fit(self) -> Board:
        """Raise ValueError for a radius that is missing or too large, or for extra keys of dots."""
        if self.has_squares:
            if self.radius is not None or "dark" in self.model_fields_set:
                raise ValueError(f"a {self.kind} has no dots; remove radius and dark")
        elif self.radius is None:
            raise ValueError(f"radius of the dots (m) is missing, {self.kind} need it")
        elif self.radius > 0.4 * self.nearest:
            raise ValueError(
                f"dots of radius {self.radius:g} m, {self.nearest:g} m from centre to centre, "
                f"nearly touch: the largest radius is {0.4 * self.nearest:.4g} m"
            )
        return self

    @property
    def has_squares(self) -> bool:
        """True for boards of squares, False for boards of dots."""
        return self.kind in ("chessboard", "charuco")

    @property
    def markers(self) -> cv2.aruco.Dictionary:
        """Dictionary of the markers of a ChArUco board."""
        return tag_dictionary(self.dictionary or "")

    def charuco(self, legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's description of a ChArUco board.

        If the number of rows of squares is even, OpenCV before version 4.6 placed the markers in
        the squares of the other colour. If ``legacy`` is True, such a board is described.
        """
        squares = (self.columns + 1, self.rows + 1)
        described = cv2.aruco.CharucoBoard(squares, self.spacing, self.marker or 0.0, self.markers)
        described.setLegacyPattern(legacy)
        return described

    @property
    def dot_radius(self) -> float:
        """Radius of the dots, m; 0 for squares."""
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
        """Permutations (n,) of the indices of all n points that a picture cannot distinguish.

        The first is the identity. The others follow from half a turn of the board, and from quarter
        turns if it has as many rows as columns. An asymmetric grid with an odd number of rows has
        only the identity, and so has a ChArUco board.
        """
        order = np.arange(self.rows * self.columns)
        if self.kind == "charuco":
            return [order]
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
        if self.dictionary is not None:
            lines += [f"marker = {self.marker!r}  # m", f'dictionary = "{self.dictionary}"']
        if self.radius is not None:
            lines += [f"radius = {self.radius!r}  # m", f"dark = {str(self.dark).lower()}"]
        return "\n".join(lines) + "\n"


def read_board(path: str | Path) -> Board:
    """Read a board file (TOML).

    Raises CalibrationError for a file that cannot be read, for an unknown key, with the valid
    names, and for an invalid value. Raises UnknownOptionError for an unknown dictionary.
    """
    source = f"board file {path}"
    content = parsed(read_text(path, source, CalibrationError), source, CalibrationError)
    return checked(Board, content, source, CalibrationError)
