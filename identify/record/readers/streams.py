"""Columns of a log by the names that they have in their file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import Protocol

import numpy as np

from identify.arrays import Array
from identify.errors import RecordError
from identify.record.columns import FRAMES, TIMES
from identify.record.telemetry import Rows

SHOWN = 40  # largest number of names that a message lists
# Text of a table, or number of a message, which is None where the message has no such entry.
Cell = str | float | int | None


@dataclass(frozen=True)
class Header:
    """Names of the columns of one part of a file, and what the file says about them."""

    names: tuple[str, ...]
    kind: str
    """Kind of the file, or of the messages of a topic."""

    units: Mapping[str, str] = field(default_factory=dict)
    """Units of columns, as the file spells them."""

    rate_hz: float | None = None
    """Frame rate that the file states, or None."""

    rotation: str | None = None
    """Convention of rotations as the file states it, or None."""


@dataclass(frozen=True)
class Stream:
    """Cells of the requested columns, and the numbers of their rows in the file."""

    columns: Mapping[str, Sequence[Cell]]
    rows: Rows

    def filled(self, names: Sequence[str]) -> list[int]:
        """Return the rows in which at least one of these columns is not empty."""
        columns = [self.columns[name] for name in names]
        cells = zip(*columns, strict=True)
        return [row for row, some in enumerate(cells) if not all(_is_empty(c) for c in some)]

    def kept(self, rows: Sequence[int]) -> "Stream":
        """Return the stream with only these rows."""
        if len(rows) == len(self.rows.numbers):
            return self
        columns = {name: [cells[row] for row in rows] for name, cells in self.columns.items()}
        numbers = [self.rows.numbers[row] for row in rows]
        return Stream(columns, Rows(self.rows.source, numbers, self.rows.word))

    def numbers(self, name: str) -> Array:
        """Return a column (N,), NaN where empty. Raises RecordError if a cell is no number."""
        cells = self.columns[name]
        values = np.empty(len(cells))
        for row, cell in enumerate(cells):
            values[row] = self._number(name, row, cell)
        return values

    def _number(self, name: str, row: int, cell: Cell) -> float:
        if cell is None or cell == "":
            return np.nan
        try:
            if isinstance(cell, str) and "_" in cell:  # float() would read 1_0 as 10
                raise ValueError
            if np.isinf(value := float(cell)):
                raise ValueError
            return value
        except ValueError:
            raise RecordError(
                f"{self.rows.place(row)}: {name} is {str(cell)[:40]!r}, which is not a number"
                f"{_comma_hint(cell)}"
            ) from None

    def moments(self, name: str, unit: str, rate_hz: float) -> list[Decimal]:
        """Return the times (N,) of a column in seconds, exactly.

        A float would round times since 1970 to a quarter of a microsecond. Raises RecordError with
        the row if a cell is not a number.
        """
        factor = Decimal(1) / Decimal(rate_hz) if unit == FRAMES else Decimal(TIMES[unit])
        found = []
        for row, cell in enumerate(self.columns[name]):
            try:
                if isinstance(cell, str) and "_" in cell:
                    raise ValueError
                moment = Decimal(cell if isinstance(cell, (str, int)) else repr(cell))
                if not abs(moment) < Decimal("1e20"):
                    raise ValueError
            except (InvalidOperation, ValueError):
                raise RecordError(
                    f"{self.rows.place(row)}: the time {name} is {str(cell)[:40]!r}, which is not "
                    f"a number{_comma_hint(cell)}"
                ) from None
            found.append(moment * factor)
        return found


def _is_empty(cell: Cell) -> bool:
    """Return whether a cell is empty. Some programs write NaN into empty cells."""
    if isinstance(cell, str):
        return not cell or cell.lower() == "nan"
    return cell is None or cell != cell


def _comma_hint(cell: Cell) -> str:
    """Return what to do about a number with a decimal comma, or an empty string."""
    if isinstance(cell, str) and re.fullmatch(r"[-+]?\d*,\d+(e[-+]?\d+)?", cell, re.IGNORECASE):
        return "; it has a decimal comma: export the log with decimal points"
    return ""


class LoggedFile(Protocol):
    """File whose columns can be read by name."""

    @property
    def headers(self) -> Mapping[str, Header]:
        """Headers by topic, or by section of an export. A table has one header named ``""``."""

    def read(self, topic: str, names: Sequence[str]) -> Stream:
        """Read columns of a topic. Raises RecordError with all columns if one is missing."""


def checked_topic(headers: Mapping[str, Header], topic: str | None, source: str) -> str:
    """Return the topic, or for None the only topic.

    Raises RecordError, with all topics, if there is no such topic, or several for None.
    """
    if topic is None and len(headers) == 1:
        return next(iter(headers))
    if topic in headers:
        return str(topic)
    listed = ", ".join(f"{name} ({header.kind})" for name, header in headers.items()) or "none"
    said = "no topic is named" if topic is None else f"there is no topic {topic!r}"
    raise RecordError(f"{source}: {said}; it has {listed}")


def check_columns(header: Header, names: Sequence[str], source: str) -> None:
    """Check that a header has each name once. Raises RecordError otherwise."""
    for name in names:
        count = header.names.count(name)
        if count > 1:
            raise RecordError(f"{source}: there are {count} columns {name!r}")
        if count == 0:
            listed = ", ".join(header.names[:SHOWN])
            more = len(header.names) - SHOWN
            raise RecordError(
                f"{source}: there is no column {name!r}; it has {listed}"
                + (f" and {more} more" if more > 0 else "")
            )
