"""Saved sessions, one JSON file each, and their comparison with the present session.

Pytest imports this module at every start. Modules that read and write files are therefore imported
only when they are needed.
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
    """A figure, and the saved figure of the same test and name."""

    now: Figure
    saved: Figure

    @property
    def mismatch(self) -> str:
        """Reason why the figures cannot be compared, or "" if they can be compared."""
        for what in ("unit", "better"):
            new = getattr(self.now, what)
            old = getattr(self.saved, what)
            if new != old:
                return f"{what} is {new!r}, was {old!r}"
        return ""

    @property
    def limit_change(self) -> str:
        """One line with the present and the saved limit, empty if they are equal."""
        now, saved = (
            f"{f.limit_text} {f.unit}".strip() if f.limit_text else "none"
            for f in (self.now, self.saved)
        )
        return (
            ""
            if now == saved
            else f"{self.now.test}: the limit of {self.now.name} is {now}, was {saved}"
        )

    @property
    def evidence_change(self) -> str:
        """One line that states how the present evidence differs, empty if it is not weaker.

        It differs if a single number replaces a sample or the reverse, or if there are fewer
        values. An interval of fewer values is wider, so it could hide a deterioration.
        """
        now = self.now
        saved = self.saved
        if (now.interval is None) == (saved.interval is None) and now.count >= saved.count:
            return ""
        return f"{now.test}: {now.name} is {_evidence(now)}, was {_evidence(saved)}"

    @property
    def change(self) -> float:
        """Growth of the value, relative to the magnitude of the saved value.

        It is infinite if the saved value is zero and the present value is not.
        """
        grown = self.now.value - self.saved.value
        if not grown:
            return 0.0
        # An infinite change has the sign of the growth.
        return grown / abs(self.saved.value) if self.saved.value else float("inf") * grown

    def worse_by_more_than(self, ratio: float) -> bool:
        """Return whether the value is worse by more than `ratio` times the saved magnitude.

        With intervals, the best end of the present interval is compared with the worst end of the
        saved interval.
        """
        sign = self.now.sign
        return sign * (self.now.best - self.saved.worst) > ratio * abs(self.saved.value)

    @property
    def regression(self) -> str:
        """One line with name, both values and the change."""
        now, saved = (
            with_unit(f"{figure.value:.6g}", self.now.unit) for figure in (self.now, self.saved)
        )
        return (
            f"{self.now.test}: {self.now.name} is {now}, was {saved}, {percent(self.change, '+.1')}"
        )


def _evidence(figure: Figure) -> str:
    return "one number" if figure.interval is None else f"a sample of {figure.count} values"


def compare(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[Key, Comparison]:
    """Pair figures with saved figures by their key. Figures without a partner are left out."""
    before = {figure.key: figure for figure in saved}
    return {
        figure.key: Comparison(figure, before[figure.key])
        for figure in figures
        if figure.key in before
    }


def missing(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[str, list[str]]:
    """Return the names of saved figures that are not among `figures`, by their test."""
    measured = {figure.key for figure in figures}
    gone: dict[str, list[str]] = {}
    for figure in saved:
        if figure.key not in measured:
            gone.setdefault(figure.test, []).append(figure.name)
    return gone


FORMAT = "cmmsim accuracy"
SCHEMA = 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def _machine() -> dict[str, str]:
    return {
        "system": platform.platform(),
        "processor": platform.machine(),
        "cores": str(os.cpu_count()),
    }


def _versions() -> dict[str, str]:
    from identify.files.versions import versions

    return versions()


@dataclass(frozen=True, kw_only=True)
class SavedSession:
    """Content of a file: the figures of a session, and the conditions of their measurement."""

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
    """Return the path of the file for a name in a folder.

    Raises AccuracyError if the name is not a valid file name on every system.
    """
    if name.endswith(".json"):
        raise AccuracyError(
            f"{name!r} is not a valid name for saved figures: use {name.removesuffix('.json')!r}, "
            "which is saved in that file"
        )
    if not NAME.fullmatch(name):
        raise AccuracyError(
            f"{name!r} is not a valid name for saved figures: use up to 100 letters, digits, '.', "
            "'_' and '-'"
        )
    return folder / f"{name}.json"


def find_saved(folder: Path, name: str) -> SavedSession:
    """Read the session that was saved under a name.

    Raises AccuracyError if there is no such session. The message lists the saved names.
    """
    path = saved_path(folder, name)
    if not path.is_file():
        names = ", ".join(sorted(path.stem for path in folder.glob("*.json"))) or "none"
        raise AccuracyError(
            f"no accuracy figures are saved as {name!r} in {folder}; saved are: {names}"
        )
    return read_saved(path)


def read_saved(path: Path) -> SavedSession:
    """Read the session in a file.

    Raises AccuracyError if the file cannot be read, holds no session, or is of another version.
    """
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
        raise AccuracyError(
            f"{path} has schema {content.get('schema')!r}, but this version reads {SCHEMA}"
        )
    try:
        return TypeAdapter(SavedSession).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise AccuracyError(
            f"{path}: {where}: {first['msg']} (got {first['input']!r:.60})"
        ) from error


def check_writable(path: Path) -> None:
    """Check that a session can be saved to a path.

    Raises AccuracyError if the path cannot be written, or the file to be replaced cannot be read as
    saved figures.
    """
    try:
        # If the folder does not exist yet, its nearest parent must be writable.
        with TemporaryFile(dir=next(place for place in path.parents if place.exists())):
            pass
        if path.exists():
            read_saved(path)
    except OSError as error:
        raise AccuracyError(f"{path} cannot be written: {error.strerror or error}") from error


def save(path: Path, session: SavedSession) -> None:
    """Write a session, whole or not at all.

    Raises AccuracyError if the file cannot be written, or holds figures that this session did not
    measure.
    """
    from identify.errors import WriteError
    from identify.files.atomic import write_text

    lost = missing(session.figures, read_saved(path).figures) if path.exists() else {}
    if lost:
        names = "; ".join(f"{test}: {', '.join(figures)}" for test, figures in lost.items())
        raise AccuracyError(
            f"not saved as {session.name}: {path} holds figures that were not measured now "
            f"({names}); use another name, or remove that file"
        )
    try:
        text = dumps(asdict(session), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        write_text(path, text, parents=True)
    except WriteError as error:
        raise AccuracyError(str(error)) from error
