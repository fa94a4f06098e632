"""What users pass as arguments and in TOML files: taken as it is meant, or refused with what was got and wanted."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from cmmsim.errors import CmmError, ShapeError

SHOWN_CHARACTERS = 120  # of what is refused


def finite_array(values: ArrayLike, shape: tuple[int, ...], wanted: str) -> NDArray[np.float64]:
    """Values as an array of that shape. Raises ShapeError, which says what is ``wanted``, for anything else than
    finite real numbers."""
    try:
        found = np.asarray(values)
        numbers = found.astype(float) if found.dtype.kind in "fiubO" else None
    except (TypeError, ValueError, OverflowError):  # ragged, or objects that are no numbers
        numbers = None
    if numbers is None:
        raise ShapeError(f"{wanted}, got {_shown(values)}")
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ShapeError(f"{wanted}, got shape {numbers.shape}: {_shown(numbers)}")
    return numbers


def require_kind(value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise CmmError, which says what is ``wanted``, unless the value is an instance of a class."""
    if not isinstance(value, kind):
        raise CmmError(f"{wanted}, got {_shown(value)} of type {type(value).__name__}")


class Section(BaseModel):
    """A section of a TOML file: no other keys than its fields, finite numbers, not changed once it is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


def read_text(path: str | PathLike, kind: str, error: type[CmmError]) -> str:
    """Text of a file; ``kind`` says in messages what it is: "sensor file". Raises ``error`` where it is no text."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as reason:
        raise error(f"cannot read {kind} {str(path)[:200]}: {reason.strerror or reason}") from reason
    except UnicodeDecodeError as reason:
        raise error(f"{kind} {path} is not text, so it cannot be TOML: {reason}") from reason


def toml_table(text: str, source: str, error: type[CmmError]) -> dict[str, Any]:
    """What a TOML text holds; ``source`` says in messages where it is from. Raises ``error`` where it is no TOML."""
    try:
        return deepcopy(_parsed(text))
    except tomllib.TOMLDecodeError as reason:
        raise error(f"{source}: {reason}") from reason


@lru_cache(maxsize=8)
def _parsed(text: str) -> dict[str, Any]:
    """Kept, for a study reads the same sensor for every row, and parsing it is an eighth of the row's time."""
    return tomllib.loads(text)


def validated(model: type[M], content: Mapping[str, Any], source: str, error: type[CmmError]) -> M:
    """The content of a file as its model; raises ``error`` in one line with the valid names for an unknown key, and
    with the value for a wrong one."""
    try:
        return model.model_validate(content)
    except ValidationError as reason:
        raise error(f"{source}: {'; '.join(_explained(model, e) for e in reason.errors())}") from reason


def _explained(model: type[BaseModel], error: Any) -> str:
    """One problem in words."""
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"unknown key {where!r}, valid are {', '.join(_valid_keys(model, error['loc'][:-1]))}"
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    # what was got instead of a missing key is the whole section
    return f"{where}: {error['msg']}" + ("" if error["type"] == "missing" else f" (got {error['input']!r})")


def _valid_keys(model: Any, section: tuple[Any, ...]) -> list[str]:
    for part in section:
        if not isinstance(part, int):
            annotation = model.model_fields[part].annotation
            model = getattr(annotation, "__args__", (annotation,))[0]
    return sorted(model.model_fields)


def _shown(values: object) -> str:
    """Values on one line, cut where they are many."""
    text = " ".join(str(values).split())
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
