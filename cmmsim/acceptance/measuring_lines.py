"""Seven measuring lines after the rules of VDI/VDE 2634-1, and the check of these rules.

The four space diagonals have an end in every corner of the volume; one diagonal of each of three faces that meet in a
corner leads along the outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cmmsim.acceptance.volume import MeasuringVolume
from cmmsim.acceptance_errors import AcceptanceError
from cmmsim.geometry.pose import Array

FEWEST_LINES, FEWEST_LENGTHS = 7, 5
LONGEST_SHARE = 2.0 / 3.0  # of the volume's space diagonal
USED_SHARE = 0.9  # of a line between the sides of the volume; the rest is room for the ends of the artefact
LENGTH_SHARES = np.array([0.19, 0.41, 0.6, 0.82, 1.0])  # test lengths of a line, of its longest
LENGTH_SHARES.setflags(write=False)
# ends of the lines in half sides of the volume
SPACE_DIAGONALS = ((-1, -1, -1), (1, -1, -1), (-1, 1, -1), (1, 1, -1))
FACE_DIAGONALS = (((-1, 1, -1), (1, -1, -1)), ((-1, 1, -1), (1, 1, 1)), ((1, 1, -1), (1, -1, 1)))
LINE_NAMES = ("space 1", "space 2", "space 3", "space 4", "front face", "bottom face", "right face")


@dataclass(frozen=True)
class MeasuringLine:
    """name; start and end (3,) of the longest test length in volume axes, m; lengths (k,) m from the start."""

    name: str
    start: Array
    end: Array
    lengths: Array

    def __post_init__(self) -> None:
        for array in (self.start, self.end, self.lengths):
            array.setflags(write=False)

    @property
    def direction(self) -> Array:
        """Unit vector (3,) from start to end."""
        return (self.end - self.start) / np.linalg.norm(self.end - self.start)


def seven_lines(volume: MeasuringVolume) -> tuple[MeasuringLine, ...]:
    """The seven lines of a volume, five test lengths each. Raises AcceptanceError when a rule is broken."""
    ends = [(np.array(a, dtype=float), -np.array(a, dtype=float)) for a in SPACE_DIAGONALS]
    ends += [(np.array(a, dtype=float), np.array(b, dtype=float)) for a, b in FACE_DIAGONALS]
    lines = tuple(
        _line(name, 0.5 * a * volume.size, 0.5 * b * volume.size) for name, (a, b) in zip(LINE_NAMES, ends, strict=True)
    )
    require_rules(lines, volume)
    return lines


def require_rules(lines: Sequence[MeasuringLine], volume: MeasuringVolume) -> None:
    """Raise AcceptanceError naming the rule that measuring lines break, the line, the value and the limit."""
    if len(lines) < FEWEST_LINES:
        raise AcceptanceError(f"{len(lines)} measuring lines, at least {FEWEST_LINES} are needed")
    for line in lines:
        different = len(np.unique(np.round(line.lengths, 6)))
        if different < FEWEST_LENGTHS:
            raise AcceptanceError(
                f"line {line.name}: {different} different test lengths, at least {FEWEST_LENGTHS} are needed"
            )
        longest, limit = line.lengths.max(), LONGEST_SHARE * volume.diagonal
        if longest < limit:
            raise AcceptanceError(
                f"line {line.name}: its longest test length of {1e3 * longest:.0f} mm is less than two thirds of the "
                f"volume's space diagonal, {1e3 * limit:.0f} mm; choose a volume nearer to a cube"
            )
        for point in (line.start, line.end):
            if np.any(np.abs(point) > 0.5 * volume.size + 1e-9):
                raise AcceptanceError(f"line {line.name} leaves the volume at {np.round(1e3 * point)} mm")


def _line(name: str, corner: Array, opposite: Array) -> MeasuringLine:
    """The middle part of a line between two corners, pulled towards the middle of the volume by the same share."""
    start, end = USED_SHARE * corner, USED_SHARE * opposite
    return MeasuringLine(name, start, end, LENGTH_SHARES * float(np.linalg.norm(end - start)))
