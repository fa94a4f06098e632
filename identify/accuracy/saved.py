"""Saved sessions: one JSON file a name, with the figures and what measured them."""

import os
import platform
import re
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from json import JSONDecodeError, dumps, loads
from pathlib import Path
from tempfile import TemporaryFile

from pydantic import ConfigDict, TypeAdapter, ValidationError

from identify.accuracy.comparison import missing
from identify.accuracy.errors import AccuracyError
from identify.accuracy.figure import CONFIDENCE, Figure
from identify.files.atomic import write_text
from identify.files.versions import versions

FORMAT, SCHEMA = "cmmsim accuracy", 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _machine() -> dict[str, str]:
    return {"system": platform.platform(), "processor": platform.machine(), "cores": str(os.cpu_count())}


@dataclass(frozen=True, kw_only=True)
class SavedSession:
    """A file's content: figures, the testbed's seed, and when, where and with which software they were measured."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: str = FORMAT
    schema: int = SCHEMA
    name: str
    created: str = field(default_factory=_now)
    machine: dict[str, str] = field(default_factory=_machine)
    versions: dict[str, str] = field(default_factory=versions)
    seed: int
    confidence: float = CONFIDENCE
    figures: list[Figure]


def saved_path(folder: Path, name: str) -> Path:
    """File of a name in a folder. Raises AccuracyError for a name that could not be one everywhere."""
    if name.endswith(".json"):
        raise AccuracyError(f"{name!r} is no name for saved figures: {name.removesuffix('.json')!r} makes that file")
    if not NAME.fullmatch(name):
        raise AccuracyError(f"{name!r} is no name for saved figures: up to 100 letters, digits, '.', '_' and '-' are")
    return folder / f"{name}.json"


def saved_names(folder: Path) -> list[str]:
    """Names that can be compared with."""
    return sorted(path.stem for path in folder.glob("*.json"))


def find_saved(folder: Path, name: str) -> SavedSession:
    """The session saved under a name. Raises AccuracyError, with the saved names, where there is none."""
    path = saved_path(folder, name)
    if not path.is_file():
        names = ", ".join(saved_names(folder)) or "none"
        raise AccuracyError(f"no accuracy figures are saved as {name!r} in {folder}; saved are: {names}")
    return read_saved(path)


def read_saved(path: Path) -> SavedSession:
    """The session in a file. Raises AccuracyError for a file that holds none, or one of another version."""
    try:
        content = loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AccuracyError(f"{path} cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, JSONDecodeError) as error:
        raise AccuracyError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise AccuracyError(f"{path} holds no accuracy figures (no entry format = {FORMAT!r})")
    if content.get("schema") != SCHEMA:
        raise AccuracyError(f"{path} has schema {content.get('schema')!r}, this version reads {SCHEMA}")
    try:
        session = TypeAdapter(SavedSession).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise AccuracyError(f"{path}: {where}: {first['msg']} (got {first['input']!r:.60})") from error
    return session


def check_writable(path: Path) -> None:
    """Raise AccuracyError where nothing can be saved, or what would be replaced is no file of saved figures."""
    try:
        with TemporaryFile(dir=next(place for place in path.parents if place.exists())):
            pass
        if path.exists():
            read_saved(path)
    except OSError as error:
        raise AccuracyError(f"{path} cannot be written: {error.strerror or error}") from error


def save(path: Path, session: SavedSession) -> None:
    """Write a session, whole or not at all. Raises AccuracyError, also where it would lose figures of another."""
    lost = missing(session.figures, read_saved(path).figures) if path.exists() else {}
    if lost:
        names = "; ".join(f"{test}: {', '.join(figures)}" for test, figures in lost.items())
        raise AccuracyError(
            f"not saved as {session.name}: {path} holds figures that were not measured now ({names}); "
            "take another name, or remove that file"
        )
    try:
        write_text(path, dumps(asdict(session), indent=2, allow_nan=False, ensure_ascii=False) + "\n")
    except OSError as error:
        raise AccuracyError(f"{path} cannot be written: {error.strerror or error}") from error
