"""Folder of a study: the resolved study, the lock while it runs, and the journal of its rows.

``study.json`` is the resolved study, with the versions of the software that began the study.
``rows.jsonl`` is the journal of finished rows, ``study.parquet`` the table of these rows, and
``study.nc`` their figures by factors.

The journal is an append-only file of JSON lines. Finished rows are flushed to the disk when they
arrive. A line counts only if it is complete. After a crash, an incomplete final line is cut off
when the file is opened again. A database (sqlite3, write-ahead log) appends 22,000 rows per second
and this journal 9,000, while rows finish at about 100 per second. With one damaged byte in the log,
the database silently returned 99 rows of 200. This journal reports the damaged line.
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
from identify.files.atomic import make_folder, remove_empty_folders, write_text
from identify.files.lock import LOCK, locked
from identify.files.run_folder import STUDY
from identify.files.versions import same_versions, versions
from identify.studies.study_design import Finished, Shared
from identify.studies.study_file import Study
from identify.studies.table import TABLE, study_in, written

JOURNAL = "rows.jsonl"
VIEW = "study.nc"
VERSIONS = "versions"

# Entries that are allowed to change in a continued study, because finished rows do not depend on
# them. Rows of added repeats come after all other rows. With fewer repeats, the surplus rows stay
# in the journal and are ignored.
MAY_CHANGE = (
    "study.title",
    "study.theory",
    "study.figures",
    "study.repeats",
    "scenario.description",
)

REMEDY = "continue with that version, or name another folder with --out"

FINISHED = TypeAdapter(Finished)


class Journal:
    """Journal of the finished rows of a study with ``rows`` rows. As a context, it closes its file.

    path              The file.
    surplus           Number of rows in the file that belong to repeats that the study no longer
                      has.
    finished (rows,)  True for each finished row, also for a failed one.
    """

    def __init__(self, path: Path, rows: int) -> None:
        self.path = path
        self.surplus = 0
        with written(path):
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        self.finished: NDArray[np.bool_] = np.zeros(rows, dtype=bool)
        self._end = 0
        for row, end in self._complete_lines():
            self._note(row)
            self._end = end
        # An incomplete final line is removed, so that the next row begins a new line.
        os.ftruncate(self._file, self._end)

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, rows: list[Finished]) -> None:
        """Add finished rows. They are on the disk when this method returns.

        Raises StudyError if the disk is full or broken. The file is then unchanged.
        """
        text = "".join(f"{json.dumps(asdict(row))}\n" for row in rows).encode()
        safe = f"; {self.finished.sum()} rows are safe, and the same command continues the study"
        with written(self.path, safe):
            try:
                os.lseek(self._file, self._end, os.SEEK_SET)
                unwritten = text
                while unwritten:  # one call may write only a part
                    unwritten = unwritten[os.write(self._file, unwritten) :]
                os.fsync(self._file)
            except OSError:
                os.ftruncate(self._file, self._end)
                raise
        self._end += len(text)
        for row in rows:
            self._note(row)

    def rows(self) -> Iterator[Finished]:
        """Yield the finished rows in the order in which they finished."""
        for row, _ in self._complete_lines():
            if row.number < len(self.finished):
                yield row

    def pending(self) -> Iterator[int]:
        """Yield the numbers of the missing rows, ascending.

        A row that finishes before its number is reached is skipped.
        """
        return (number for number in range(len(self.finished)) if not self.finished[number])

    def _note(self, row: Finished) -> None:
        if row.number < len(self.finished):
            self.finished[row.number] = True
        else:
            self.surplus += 1

    def _complete_lines(self) -> Iterator[tuple[Finished, int]]:
        """Yield row and end [byte] of each complete line. Raises StudyError for a damaged line."""
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
    """Return the study, its scenario and its sensor, on which its rows depend, as JSON values."""
    scenario = shared.scenario
    sensor = read_sensor_file(scenario.sensor, scenario.sensor_changes)
    entry = {
        "study": study.model_dump(mode="json"),
        "scenario": scenario.model_dump(mode="json"),
        "sensor": sensor.model_dump(mode="json"),
    }
    # The entry is compared with a JSON file, in which tuples are lists.
    return dict(json.loads(json.dumps(entry)))


@contextmanager
def open_folder(folder: Path, entry: dict[str, Any], rows: int) -> Iterator[Journal]:
    """Open and lock the folder of a resolved study, new or begun before.

    If a new study is refused before its first row, its new files and folders are removed. After
    Ctrl-C they are not removed.

    entry  The resolved study.
    rows   Number of its rows.

    Raises StudyError if the folder belongs to another study, is in use, holds other files or cannot
    be made, if one of its files is damaged, or if another version of cmmsim computed the first rows
    and rows are missing.
    """
    _check_content(folder)
    _check_entries(folder)
    new = not (folder / STUDY).exists()
    try:
        new_folders = make_folder(folder)
    except OSError as error:
        raise StudyError(
            f"study folder {folder} cannot be made: {error.strerror}; name another with --out"
        ) from error
    try:
        with _locked_study(folder, entry, rows, new) as journal:
            yield journal
    finally:
        remove_empty_folders(new_folders)


@contextmanager
def _locked_study(folder: Path, entry: dict[str, Any], rows: int, new: bool) -> Iterator[Journal]:
    """Lock a study's folder, and open its journal. ``new``: the study did not exist before."""
    with locked(folder, StudyError):
        try:
            begun = _claim(folder, entry)
            with Journal(folder / JOURNAL, rows) as journal:
                # A finished study gets no rows, so any version is allowed to tabulate it.
                if not journal.finished.all():
                    same_versions({f"the study in {folder}": begun}, REMEDY)
                yield journal
        except StudyError as error:
            if new and not _has_rows(folder) and not isinstance(error, StudyInterrupted):
                _remove_new_files(folder)
            raise


def _check_content(folder: Path) -> None:
    """Raise StudyError if the path is a file, or if the folder has other files and no study."""
    if folder.exists() and not folder.is_dir():
        raise StudyError(f"study folder {folder} is a file; name another with --out")
    if folder.is_dir() and not (folder / STUDY).exists():
        others = sorted(path.name for path in folder.iterdir() if path.name not in (LOCK, TABLE))
        if others:
            raise StudyError(
                f"study folder {folder} holds {others[0]} and no {STUDY}; name another with --out"
            )


def _check_entries(folder: Path) -> None:
    """Raise StudyError if a link, a pipe or the like has the name of a study's file.

    Reading a pipe would wait forever, and rows would be written to the target of a link.
    """
    for name in (STUDY, JOURNAL, TABLE, VIEW):
        path = folder / name
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise StudyError(f"{path} is a link or not a file; name another folder with --out")


def _claim(folder: Path, entry: dict[str, Any]) -> dict[str, str]:
    """Write study.json, and return the versions of the software that computed the first rows.

    Raises StudyError if the folder belongs to another study.
    """
    here = _study_file(folder / STUDY)
    stored: dict[str, str] | None = here.pop(VERSIONS, None) if here else None
    # A study without rows gets the present versions.
    begun = stored if stored and _has_rows(folder) else versions()
    for name, other in ((STUDY, here), (TABLE, study_in(folder / TABLE))):
        if other is not None and (others := _differences(other, entry)):
            raise StudyError(
                f"{folder / name} belongs to another study, which differs in "
                f"{', '.join(others[:4])}; name another folder with --out"
            )
    with written(folder / STUDY):
        write_text(folder / STUDY, json.dumps(entry | {VERSIONS: begun}, indent=1) + "\n")
    return begun


def _remove_new_files(folder: Path) -> None:
    """Remove the files of a study that did not begin."""
    with suppress(OSError):
        for name in (STUDY, JOURNAL, LOCK):
            (folder / name).unlink(missing_ok=True)


def _has_rows(folder: Path) -> bool:
    return (folder / JOURNAL).exists() and (folder / JOURNAL).stat().st_size > 0


def _study_file(path: Path) -> dict[str, Any] | None:
    """Return the content of study.json, or None without it. Raises StudyError if it is damaged."""
    if not path.exists():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise StudyError(f"{path} is damaged: {error}") from error


def _differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Return the paths at which two resolved studies differ, without entries in MAY_CHANGE."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        return [
            different
            for name in keys
            for different in _differences(
                one.get(name), other.get(name), f"{path}.{name}" if path else name
            )
        ]
    return [] if one == other or path in MAY_CHANGE else [path]
