"""Saved sessions, one JSON file a name, and what got worse, is held to another limit or is gone since.

Imported at every start of pytest: what reads and writes files is imported when there is one.
"""

import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from json import JSONDecodeError, dumps, loads
from pathlib import Path
from tempfile import TemporaryFile

from identify.accuracy.figure import CONFIDENCE, AccuracyError, Figure, percent, with_unit

Key = tuple[str, str]


@dataclass(frozen=True)
class Comparison:
    """A figure, and the one that was saved under the same test and name."""

    now: Figure
    saved: Figure

    @property
    def mismatch(self) -> str:
        """Why the two cannot be compared, or nothing."""
        for what in ("unit", "better"):
            new, old = getattr(self.now, what), getattr(self.saved, what)
            if new != old:
                return f"{what} is {new!r}, was {old!r}"
        return ""

    @property
    def limit_change(self) -> str:
        """One line: name, limit and the saved one, where they differ; or nothing."""
        now, saved = (f"{f.limit_text} {f.unit}".strip() if f.limit_text else "none" for f in (self.now, self.saved))
        return "" if now == saved else f"{self.now.test}: the limit of {self.now.name} is {now}, was {saved}"

    @property
    def evidence_change(self) -> str:
        """One line: name, and what stands behind its value now and before, where that is something else or less; or
        nothing. An interval of fewer values is wider, and would hold what the saved one did not."""
        now, saved = self.now, self.saved
        if (now.interval is None) == (saved.interval is None) and now.count >= saved.count:
            return ""
        return f"{now.test}: {now.name} is {_evidence(now)}, was {_evidence(saved)}"

    @property
    def change(self) -> float:
        """Growth of the value as a share of the saved one's size; infinite from zero to anything else."""
        grown = self.now.value - self.saved.value
        if not grown:
            return 0.0
        return grown / abs(self.saved.value) if self.saved.value else float("inf") * grown

    def worse_by_more_than(self, ratio: float) -> bool:
        """Whether the value got worse by more than this share of the saved one's size.

        Where there are intervals, only if even the good end of the new one is that much worse than the bad end of the
        saved one.
        """
        sign = self.now.sign
        return sign * (self.now.best - self.saved.worst) > ratio * abs(self.saved.value)

    @property
    def regression(self) -> str:
        """One line: name, both values and the change."""
        now, saved = (with_unit(f"{figure.value:.6g}", self.now.unit) for figure in (self.now, self.saved))
        return f"{self.now.test}: {self.now.name} is {now}, was {saved}, {percent(self.change, '+.1')}"


def _evidence(figure: Figure) -> str:
    return "one number" if figure.interval is None else f"a sample of {figure.count} values"


def compare(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[Key, Comparison]:
    """Pairs of figures by their key; figures that have no partner are left out."""
    before = {figure.key: figure for figure in saved}
    return {figure.key: Comparison(figure, before[figure.key]) for figure in figures if figure.key in before}


def missing(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[str, list[str]]:
    """Names of the saved figures that are not among these, by their test."""
    measured = {figure.key for figure in figures}
    gone: dict[str, list[str]] = {}
    for figure in saved:
        if figure.key not in measured:
            gone.setdefault(figure.test, []).append(figure.name)
    return gone


FORMAT, SCHEMA = "cmmsim accuracy", 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def _machine() -> dict[str, str]:
    return {"system": platform.platform(), "processor": platform.machine(), "cores": str(os.cpu_count())}


def _versions() -> dict[str, str]:
    from identify.files.versions import versions

    return versions()


@dataclass(frozen=True, kw_only=True)
class SavedSession:
    """A file's content: figures, the testbed's seed, and when, where and with which software they were measured."""

    __pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # noqa: RUF012  as pydantic wants it

    format: str = FORMAT
    schema: int = SCHEMA
    name: str
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    machine: dict[str, str] = field(default_factory=_machine)
    versions: dict[str, str] = field(default_factory=_versions)
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


def find_saved(folder: Path, name: str) -> SavedSession:
    """The session saved under a name. Raises AccuracyError, with the saved names, where there is none."""
    path = saved_path(folder, name)
    if not path.is_file():
        names = ", ".join(sorted(path.stem for path in folder.glob("*.json"))) or "none"
        raise AccuracyError(f"no accuracy figures are saved as {name!r} in {folder}; saved are: {names}")
    return read_saved(path)


def read_saved(path: Path) -> SavedSession:
    """The session in a file. Raises AccuracyError for a file that holds none, or one of another version."""
    from pydantic import TypeAdapter, ValidationError

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
        return TypeAdapter(SavedSession).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise AccuracyError(f"{path}: {where}: {first['msg']} (got {first['input']!r:.60})") from error


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
    from identify.files.atomic import write_text

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
