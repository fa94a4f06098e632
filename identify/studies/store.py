"""Folder of a study: its owner, the lock while somebody works on it, and the journal of its rows.

``study.json`` is the resolved study with the versions of the software that began it. ``rows.jsonl``
holds its finished rows, ``study.parquet`` the table made of them, and ``study.nc`` their figures by
factors.

The journal is an append-only file of JSON lines. Rows are on the disk before the next ones begin. A
line counts only if it is complete: whatever ends the program, a line that was written stays, and a
torn last one is cut off when the file is opened again. A database (sqlite3, write-ahead log)
appends 22,000 rows a second where this appends 9,000, and rows come at 100 a second. With one byte
of its log damaged, the database silently gave back 99 rows of 200, where this names the line.
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
from identify.files.atomic import make_folder, take_back, write_text
from identify.files.lock import LOCK, locked
from identify.files.versions import same_versions, versions
from identify.studies.study_design import Finished, Shared
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
"""Entries that may change in a study that is continued, because they decide no row that is there.

Rows of further repeats come after all others. With fewer repeats, the rows beyond stay in the
journal and do not count.
"""

REMEDY = "go on with that version, or name another folder with --out"

FINISHED = TypeAdapter(Finished)


class Journal:
    """Finished rows of a study with ``rows`` rows, as a context that closes the file.

    Attributes
    ----------
    path : Path
        The file.
    beyond : int
        Number of rows in the file of repeats that the study had before and no longer has.
    finished : ndarray of bool, shape (rows,)
        Mark of each row that is done.
    """

    def __init__(self, path: Path, rows: int) -> None:
        self.path = path
        self.beyond = 0
        with written(path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        self.finished: NDArray[np.bool_] = np.zeros(rows, dtype=bool)
        self._end = 0
        for row, end in self._complete_lines():
            self._note(row)
            self._end = end
        # A torn last line goes, so that the next row begins a line of its own.
        os.ftruncate(self._file, self._end)

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, rows: list[Finished]) -> None:
        """Add finished rows. They are on the disk when this returns.

        Raises StudyError if the disk is full or broken. The file is then as it was before.
        """
        text = "".join(f"{json.dumps(asdict(row))}\n" for row in rows).encode()
        safe = f"; {self.finished.sum()} rows are safe, and the same command goes on from there"
        with written(self.path, safe):
            try:
                os.lseek(self._file, self._end, os.SEEK_SET)
                left = text
                while left:  # one call may write only a part
                    left = left[os.write(self._file, left) :]
                os.fsync(self._file)
            except OSError:
                os.ftruncate(self._file, self._end)
                raise
        self._end += len(text)
        for row in rows:
            self._note(row)

    def rows(self) -> Iterator[Finished]:
        """Yield the finished rows in the order in which they were done."""
        for row, _ in self._complete_lines():
            if row.number < len(self.finished):
                yield row

    def pending(self) -> Iterator[int]:
        """Yield the numbers of the rows still to be done, ascending.

        Whether a row is done is looked up when its number is reached.
        """
        return (number for number in range(len(self.finished)) if not self.finished[number])

    def _note(self, row: Finished) -> None:
        if row.number < len(self.finished):
            self.finished[row.number] = True
        else:
            self.beyond += 1

    def _complete_lines(self) -> Iterator[tuple[Finished, int]]:
        """Yield rows with the place where each line ends, up to a torn last line."""
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


def resolved(study: Study, shared: Shared) -> dict[str, Any]:
    """Return everything that decides the rows of a study, as JSON has it.

    It is the study's file, and the scenario and sensor that it names.
    """
    scenario = shared.scenario
    sensor = read_sensor_file(scenario.sensor, scenario.sensor_changes)
    entry = {
        "study": study.model_dump(mode="json"),
        "scenario": scenario.model_dump(mode="json"),
        "sensor": sensor.model_dump(mode="json"),
    }
    # Through JSON and back, as tuples become lists in the file with which this is compared.
    return dict(json.loads(json.dumps(entry)))


@contextmanager
def open_folder(folder: Path, entry: dict[str, Any], rows: int) -> Iterator[Journal]:
    """Work on the folder of a resolved study, new or begun before, while nobody else may.

    A study that is refused before its first row leaves nothing behind that was not there. Ctrl-C
    leaves a study that has begun.

    Parameters
    ----------
    folder : Path
        The folder.
    entry : dict
        The resolved study.
    rows : int
        Number of its rows.

    Raises
    ------
    StudyError
        The folder is of another study, in use, holds something else or cannot be made, one of its
        files is damaged, or rows would be added to those of another version of cmmsim.
    """
    _check_content(folder)
    _check_entries(folder)
    new = not (folder / STUDY).exists()
    try:
        made = make_folder(folder)
    except OSError as error:
        raise StudyError(
            f"study folder {folder} cannot be made: {error.strerror}; name another with --out"
        ) from error
    try:
        with _locked_study(folder, entry, rows, new) as journal:
            yield journal
    finally:
        take_back(made)


@contextmanager
def _locked_study(folder: Path, entry: dict[str, Any], rows: int, new: bool) -> Iterator[Journal]:
    """Hold the lock of a study's folder; ``new``: the study is not there before."""
    with locked(folder, StudyError):
        try:
            begun = _claim(folder, entry)
            with Journal(folder / JOURNAL, rows) as journal:
                # A finished study gets no rows, so any version may tabulate it.
                if not journal.finished.all():
                    same_versions({f"the study in {folder}": begun}, REMEDY)
                yield journal
        except StudyError as error:
            if new and not _has_rows(folder) and not isinstance(error, StudyInterrupted):
                _take_back(folder)
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
    """Refuse links, pipes and the like under the names of a study's files.

    A pipe would be waited for without end, and rows would be written to where a link points.
    """
    for name in (STUDY, JOURNAL, TABLE, VIEW):
        path = folder / name
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise StudyError(f"{path} is a link or no file; name another folder with --out")


def _claim(folder: Path, entry: dict[str, Any]) -> dict[str, str]:
    """Make the folder that of a study, or refuse if it is that of another.

    Returns the versions that began its rows.
    """
    here = _study_file(folder / STUDY)
    stored: dict[str, str] | None = here.pop(VERSIONS, None) if here else None
    # A study without rows begins with the versions of today.
    begun = stored if stored and _has_rows(folder) else versions()
    for name, found in ((STUDY, here), (TABLE, study_in(folder / TABLE))):
        if found is not None and (others := _differences(found, entry)):
            raise StudyError(
                f"{folder / name} is of another study, which differs in {', '.join(others[:4])}; "
                "name another folder with --out"
            )
    with written(folder / STUDY):
        write_text(folder / STUDY, json.dumps(entry | {VERSIONS: begun}, indent=1) + "\n")
    return begun


def _take_back(folder: Path) -> None:
    """Remove the files of a study that did not begin."""
    with suppress(OSError):
        for name in (STUDY, JOURNAL, LOCK):
            (folder / name).unlink(missing_ok=True)


def _has_rows(folder: Path) -> bool:
    return (folder / JOURNAL).exists() and (folder / JOURNAL).stat().st_size > 0


def _study_file(path: Path) -> dict[str, Any] | None:
    """Return what a folder states of its study, or None."""
    if not path.exists():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise StudyError(f"{path} is damaged: {error}") from error


def _differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Return the paths at which two resolved studies differ in what decides their rows."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        return [
            d
            for k in keys
            for d in _differences(one.get(k), other.get(k), f"{path}.{k}" if path else k)
        ]
    return [] if one == other or path in MAY_CHANGE else [path]
