"""The finished rows of a study in an append-only file: JSON lines, on the disk before the next rows are begun.

A line is complete or it does not count. Whatever ends the program, a line that was written stays, and a torn last one
is cut off when the file is opened again. Rows beyond those of the study, of repeats that it had before, stay too; they
are only counted, as `beyond`.
"""

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from identify.errors import StudyError
from identify.studies.computation import Finished

FINITE = sys.float_info.max


class Journal:
    """Finished rows of a study with ``rows`` rows; a context that closes the file."""

    def __init__(self, path: Path, rows: int) -> None:
        self.path, self.beyond = path, 0
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        self.finished: NDArray[np.bool_] = np.zeros(rows, dtype=bool)
        self._end = 0
        for row, end in self._complete_lines():
            self._note(row)
            self._end = end
        os.ftruncate(self._file, self._end)

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, rows: list[Finished]) -> None:
        """Add finished rows; when this returns they are on the disk.

        Raises:
            StudyError: the disk is full or broken; the file is as it was before.
        """
        text = "".join(f"{json.dumps(asdict(row))}\n" for row in rows).encode()
        try:
            written = 0
            while written < len(text):
                written += os.pwrite(self._file, text[written:], self._end + written)
            os.fsync(self._file)
        except OSError as error:
            os.ftruncate(self._file, self._end)
            raise StudyError(
                f"{self.path} cannot be written: {error.strerror}; {self.finished.sum()} rows are safe, and the same "
                "command goes on from there"
            ) from error
        self._end += len(text)
        for row in rows:
            self._note(row)

    def rows(self) -> Iterator[Finished]:
        """The finished rows in the order in which they were done."""
        for row, _ in self._complete_lines():
            if row.number < len(self.finished):
                yield row

    def pending(self) -> Iterator[int]:
        """Numbers of the rows that are still to be done, ascending; those that are done meanwhile may be among them."""
        return (number for number in range(len(self.finished)) if not self.finished[number])

    def _note(self, row: Finished) -> None:
        if row.number < len(self.finished):
            self.finished[row.number] = True
        else:
            self.beyond += 1

    def _complete_lines(self) -> Iterator[tuple[Finished, int]]:
        """Rows with the place where each line ends, up to the end of the file or to a torn last line."""
        with self.path.open("rb") as file:
            end = 0
            for number, line in enumerate(file, 1):
                end += len(line)
                if not line.endswith(b"\n"):
                    return
                yield _parsed(line, f"line {number} of {self.path}"), end


def _parsed(line: bytes, where: str) -> Finished:
    try:
        return _checked(Finished(**json.loads(line)))
    except (ValueError, TypeError) as error:
        raise StudyError(f"{where} is damaged: {error}") from error


def _checked(row: Finished) -> Finished:
    """The row, if a study can have written it. Raises ValueError with the entry and its value if not."""
    if type(row.number) is not int or row.number < 0:
        raise ValueError(f"number is {row.number!r}, no number of a row")
    if not isinstance(row.error, str):
        raise ValueError(f"error is {row.error!r}, no text")
    if not isinstance(row.figures, dict):
        raise ValueError(f"figures is {row.figures!r:.60}, no table")
    for name, value in [*row.figures.items(), ("seconds", row.seconds)]:
        if type(value) not in (int, float) or not -FINITE <= value <= FINITE:
            raise ValueError(f"{name} is {value!r:.60}, no finite number")
    return row
