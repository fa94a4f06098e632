"""The folder of a study: whose it is, who works on it, and the journal of what is done.

``study.json`` is the resolved study with the versions of the software that began it, ``rows.jsonl``
its finished rows, ``study.parquet`` the table made of them, ``study.nc`` their figures by factors.

The journal is an append-only file of JSON lines, on the disk before the next rows are begun. A line
is complete or it does not count: whatever ends the program, a line that was written stays, and a
torn last one is cut off when the file is opened again. A database (sqlite3, write-ahead log)
appends 22,000 rows a second where this appends 9,000, and rows come 100 a second; with one byte of
its log damaged it silently gave back 99 rows of 200, where this names the line.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from cmmsim.files import read_sensor_file
from identify.errors import StudyError, StudyInterrupted
from identify.files.atomic import write_text
from identify.files.lock import LOCK, locked
from identify.files.versions import same_versions, versions
from identify.studies.design import Finished, Setup
from identify.studies.study_file import Study
from identify.studies.table import TABLE, study_in, written

STUDY = "study.json"
JOURNAL = "rows.jsonl"
VIEW = "study.nc"
VERSIONS = "versions"

MAY_CHANGE = (
    "study.title",
    "study.theory",
    "study.figures",
    "study.repeats",
    "scenario.description",
)
"""What may change in a study that is continued: it decides no row that is there. Further repeats
have rows of their own after all others; with fewer, the rows beyond stay in the journal and count
for nothing."""

REMEDY = "go on with that version, or name another folder with --out"

FINISHED = TypeAdapter(Finished)


class Journal:
    """Finished rows of a study with ``rows`` rows; a context that closes the file.

    beyond: how many rows it has of repeats that the study had before.
    """

    def __init__(self, path: Path, rows: int) -> None:
        self.path = path
        self.beyond = 0
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
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

        Raises StudyError: the disk is full or broken; the file is as it was before.
        """
        text = "".join(f"{json.dumps(asdict(row))}\n" for row in rows).encode()
        safe = f"; {self.finished.sum()} rows are safe, and the same command goes on from there"
        with written(self.path, safe):
            try:
                os.lseek(self._file, self._end, os.SEEK_SET)
                left = text
                while left:
                    left = left[os.write(self._file, left) :]
                os.fsync(self._file)
            except OSError:
                os.ftruncate(self._file, self._end)
                raise
        self._end += len(text)
        for row in rows:
            self._note(row)

    def rows(self) -> Iterator[Finished]:
        """The finished rows in the order in which they were done."""
        for row, _ in self._complete_lines():
            if row.number < len(self.finished):
                yield row

    def pending(self) -> Iterator[int]:
        """Numbers of the rows that are still to be done, ascending; those that are done meanwhile
        may be among them.
        """
        return (number for number in range(len(self.finished)) if not self.finished[number])

    def _note(self, row: Finished) -> None:
        if row.number < len(self.finished):
            self.finished[row.number] = True
        else:
            self.beyond += 1

    def _complete_lines(self) -> Iterator[tuple[Finished, int]]:
        """Rows with the place where each line ends, up to the end of the file or to a torn last
        line.
        """
        with self.path.open("rb") as file:
            end = 0
            for number, line in enumerate(file, 1):
                end += len(line)
                if not line.endswith(b"\n"):
                    return
                try:
                    yield FINISHED.validate_json(line), end
                except ValidationError as error:
                    wrong = error.errors()[0]
                    what = ".".join(map(str, wrong["loc"])) or "it"
                    raise StudyError(
                        f"line {number} of {self.path} is damaged: {what} is "
                        f"{wrong['input']!r:.60}: {wrong['msg']}"
                    ) from error


def resolved(study: Study, setup: Setup) -> dict[str, Any]:
    """Everything that decides the rows of a study, as JSON has it: its file, and the scenario and
    sensor it names.
    """
    scenario = setup.scenario
    sensor = read_sensor_file(scenario.sensor, scenario.sensor_changes)
    entry = {
        "study": study.model_dump(mode="json"),
        "scenario": scenario.model_dump(mode="json"),
        "sensor": sensor.model_dump(mode="json"),
    }
    return dict(json.loads(json.dumps(entry)))


@contextmanager
def open_folder(folder: Path, entry: dict[str, Any], rows: int) -> Iterator[Journal]:
    """Work on the folder of a resolved study with ``rows`` rows, new or begun before; nobody else
    may meanwhile.

    What refuses the study before its first row leaves nothing behind that was not there; Ctrl-C
    leaves a study begun.

    Raises StudyError: the folder is of another study, in use, holds something else or cannot be
    made; one of its files is damaged; rows would be added to those of another version of cmmsim.
    """
    _check_content(folder)
    _check_entries(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    new = not (folder / STUDY).exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(
            f"study folder {folder} cannot be made: {error.strerror}; name another with --out"
        ) from error
    with locked(folder, StudyError):
        try:
            begun = _claim(folder, entry)
            with Journal(folder / JOURNAL, rows) as journal:
                if not journal.finished.all():
                    same_versions({f"the study in {folder}": begun}, REMEDY)
                yield journal
        except StudyError as error:
            if new and not _has_rows(folder) and not isinstance(error, StudyInterrupted):
                _take_back(folder, made)
            raise


def _check_content(folder: Path) -> None:
    """Refuse to put a study among files that are not a study's."""
    if folder.exists() and not folder.is_dir():
        raise StudyError(f"study folder {folder} is a file; name another with --out")
    if folder.is_dir() and not (folder / STUDY).exists():
        others = sorted(path.name for path in folder.iterdir() if path.name not in (LOCK, TABLE))
        if others:
            raise StudyError(
                f"study folder {folder} holds {others[0]} and no {STUDY}; name another with --out"
            )


def _check_entries(folder: Path) -> None:
    """Refuse what is no file of a study under the name of one: a pipe would be waited for without
    end, and rows would be written to where a link points.
    """
    for name in (STUDY, JOURNAL, TABLE, VIEW):
        path = folder / name
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise StudyError(f"{path} is a link or no file; name another folder with --out")


def _claim(folder: Path, entry: dict[str, Any]) -> dict[str, str]:
    """Make the folder that of a study, or refuse where it is that of another; versions that began
    its rows.
    """
    here = _study_file(folder / STUDY)
    stored: dict[str, str] | None = here.pop(VERSIONS, None) if here else None
    begun = stored if stored and _has_rows(folder) else versions()
    for name, found in ((STUDY, here), (TABLE, study_in(folder / TABLE))):
        if found is not None and (others := _differences(found, entry)):
            raise StudyError(
                f"{folder / name} is of another study, which differs in {', '.join(others[:4])}; "
                "name another folder "
                "with --out"
            )
    with written(folder / STUDY):
        write_text(folder / STUDY, json.dumps(entry | {VERSIONS: begun}, indent=1) + "\n")
    return begun


def _take_back(folder: Path, made: list[Path]) -> None:
    """Remove what was made of a study that did not begin: its files, then the folders made for it,
    the inmost first.
    """
    with suppress(OSError):  # where somebody else has put something there meanwhile, it stays
        for name in (STUDY, JOURNAL, LOCK):
            (folder / name).unlink(missing_ok=True)
        for path in made:
            path.rmdir()


def _has_rows(folder: Path) -> bool:
    return (folder / JOURNAL).exists() and (folder / JOURNAL).stat().st_size > 0


def _study_file(path: Path) -> dict[str, Any] | None:
    """What a folder says of its study; None where it says nothing."""
    if not path.exists():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise StudyError(f"{path} is damaged: {error}") from error


def _differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Paths at which two resolved studies differ in what decides their rows."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        return [
            d
            for k in keys
            for d in _differences(one.get(k), other.get(k), f"{path}.{k}" if path else k)
        ]
    return [] if one == other or path in MAY_CHANGE else [path]
