"""Tables as CSV: plain ones, and exports of Motive and Vicon with headers of several lines.

Motive writes the names of the bodies above the columns of their rotations and positions. Vicon
writes a section for each kind of data, with the rate, bodies, components and units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path

from identify.errors import RecordError
from identify.record.csv_record import lines_of
from identify.record.readers.streams import Header, Stream, check_columns
from identify.record.telemetry import Rows

MOTIVE = "Format Version"  # first cell of an export of Motive
# Titles of the sections of an export of Vicon.
VICON = ("Segments", "Objects", "Joints", "Model Outputs", "Trajectories", "Devices")
FRAME = "Frame"  # first column of both exports

SEPARATORS = ",;\t"  # possible separators of cells

Line = tuple[int, list[str]]  # number of a line, and its cells


@dataclass(frozen=True)
class Part:
    """Header and rows of a table."""

    header: Header
    rows: Sequence[Line]


@dataclass(frozen=True)
class LoggedTable:
    """Table whose columns can be read by name."""

    path: Path

    @cached_property
    def parts(self) -> Mapping[str, Part]:
        """Parts by the titles of their sections. Raises RecordError for a file without a header."""
        lines = list(lines_of(self.path, SEPARATORS))
        if not lines:
            raise RecordError(f"{self.path} has no lines")
        first = lines[0][1]
        if first[0] == MOTIVE:
            return {"": _motive(self.path, lines)}
        if first[0] in VICON and not any(first[1:]):
            return _vicon(self.path, lines)
        return {"": Part(Header(tuple(first), "CSV"), lines[1:])}

    @property
    def headers(self) -> Mapping[str, Header]:
        """Headers by the titles of their sections."""
        return {title: part.header for title, part in self.parts.items()}

    def read(self, topic: str, names: Sequence[str]) -> Stream:
        """Read columns of a section.

        Raises RecordError if a column or all rows are missing, or a row has a wrong length.
        """
        part = self.parts[topic]
        source = f"{self.path} {topic}".rstrip()
        check_columns(part.header, names, source)
        if not part.rows:
            raise RecordError(f"{source} has no rows below its header")
        width = len(part.header.names)
        for number, cells in part.rows:
            # Exports leave out empty cells at the end of a row.
            if len(cells) > width or (len(cells) < width and part.header.kind == "CSV"):
                raise RecordError(
                    f"{self.path} line {number} has {len(cells)} cells, and the header has {width} "
                    "columns"
                )
        indices = {name: part.header.names.index(name) for name in names}
        columns = {
            name: [cells[index] if index < len(cells) else "" for _, cells in part.rows]
            for name, index in indices.items()
        }
        return Stream(columns, Rows(str(self.path), tuple(number for number, _ in part.rows)))


def _motive(path: Path, lines: Sequence[Line]) -> Part:
    """Return the table of an export of Motive."""
    pairs = lines[0][1]
    said = dict(zip(pairs[::2], pairs[1::2], strict=False))
    bottom = _component_line(path, lines)
    above = [cells for _, cells in lines[1:bottom]]
    # In newer versions, the second cell of a line of the header says what the line contains.
    named = [cells for cells in above if len(cells) > 1 and cells[1] == "Name"]
    if len(above) < 3:
        raise RecordError(f"{path}: the header of this Motive export has no names of bodies")
    bodies = named[0] if named else above[1]
    stacked = list(zip_longest(bodies, above[-1], lines[bottom][1], fillvalue=""))
    names = [
        components if column < 2 else " ".join(filter(None, (body, kind, components)))
        for column, (body, kind, components) in enumerate(stacked)
    ]
    length = said.get("Length Units", "")
    positions = [kind == POSITION for _, kind, _ in stacked]
    units = {name: length for name, held in zip(names, positions, strict=True) if held}
    header = Header(
        tuple(names),
        "Motive",
        units,
        _rate(said.get("Export Frame Rate") or said.get("Capture Frame Rate") or ""),
        said.get("Rotation Type"),
    )
    return Part(header, lines[bottom + 1 :])


POSITION = "Position"  # word above the columns of a position in an export of Motive


def _vicon(path: Path, lines: Sequence[Line]) -> dict[str, Part]:
    """Return the sections of an export of Vicon by their titles."""
    starts = [k for k, (_, cells) in enumerate(lines) if cells[0] in VICON and not any(cells[1:])]
    parts = {}
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        section = lines[start:end]
        bottom = _component_line(path, section)
        components = section[bottom][1]
        units = section[bottom + 1][1] if bottom + 1 < len(section) else []
        bodies: list[str] = []
        # The name of a body is above the first of its columns. The first two are frame numbers.
        for column, _ in enumerate(components):
            above = section[bottom - 1][1]
            own = above[column] if column < len(above) else ""
            bodies.append(own or (bodies[-1] if column > 2 else ""))
        names = [" ".join(filter(None, pair)) for pair in zip(bodies, components, strict=True)]
        stated = {name: unit for name, unit in zip(names, units, strict=False) if unit}
        header = Header(tuple(names), "Vicon", stated, _rate(section[1][1][0]))
        parts[section[0][1][0]] = Part(header, section[bottom + 2 :])
    return parts


def _component_line(path: Path, lines: Sequence[Line]) -> int:
    """Return the index of the line with the components, which begins with the word Frame."""
    for index, (_, cells) in enumerate(lines):
        if cells[0] == FRAME:
            return index
    raise RecordError(
        f"{path} line {lines[0][0]}: below this line there is no header that begins with {FRAME}"
    )


def _rate(text: str) -> float | None:
    try:
        rate = float(text)
    except ValueError:
        return None
    return rate if rate > 0 else None
