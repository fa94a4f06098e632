"""What users pass as arguments and in TOML files: taken as it is meant, or refused with what was got and wanted."""

import operator
import tomllib
from copy import deepcopy
from functools import lru_cache
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
    if numbers.shape != shape:
        raise ShapeError(f"{wanted}, got shape {numbers.shape}: {_shown(numbers)}")
    if not np.isfinite(numbers).all():
        first = tuple(np.argwhere(~np.isfinite(numbers))[0].tolist())
        where = f" at {list(first)}: {_shown(numbers)}" if first else ""
        raise ShapeError(f"{wanted}, got {numbers[first]}{where}")
    return numbers


def require_kind(value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise CmmError, which says what is ``wanted``, unless the value is an instance of a class."""
    if not isinstance(value, kind):
        raise CmmError(f"{wanted}, got {_shown(value)} of type {type(value).__name__}")


class Section(BaseModel):
    """A section of a TOML file: no other keys than its fields, finite numbers, not changed once it is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


def read_text(path: str | Path, source: str, refusal: type[CmmError]) -> str:
    """Text of a file. Raises ``refusal`` where it cannot be read; source: how messages call it, as "board file x"."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise refusal(f"cannot read {source}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise refusal(f"{source} is not text, so it cannot be TOML: {error}") from error


def parsed(text: str, source: str, refusal: type[CmmError]) -> dict[str, Any]:
    """Content of a text, the caller's to change. Raises ``refusal`` where it is not TOML."""
    try:
        return deepcopy(_parsed(text))
    except tomllib.TOMLDecodeError as error:
        raise refusal(f"{source} is not TOML: {error}") from error


def checked(model: type[M], content: dict[str, Any], source: str, refusal: type[CmmError]) -> M:
    """Content as a model. Raises ``refusal`` with all that is wrong, and with the valid names of an unknown key."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise refusal(f"{source}: {'; '.join(_explain(details, model) for details in error.errors())}") from error


@lru_cache(maxsize=8)
def _parsed(text: str) -> dict[str, Any]:
    """Kept, for a study reads the same sensor for every row, and parsing it is an eighth of the row's time."""
    return tomllib.loads(text)


def _explain(error: Any, model: type[BaseModel]) -> str:
    """One problem in words."""
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"unknown key {where!r}, valid are {', '.join(_valid_keys(error['loc'][:-1], model))}"
    if error["type"] == "missing":
        return f"{where}: {error['msg']}"  # what was got instead is the whole section
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    return f"{where}: {error['msg']} (got {error['input']!r})"


def _valid_keys(section: tuple[Any, ...], model: Any) -> list[str]:
    for part in section:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        model = getattr(annotation, "__args__", (annotation,))[0]
    return sorted(model.model_fields)


def _shown(values: object) -> str:
    """Values on one line, cut where they are many."""
    text = " ".join(str(values).split())
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def checked_seed(seed: int) -> int:
    """The seed. Raises CmmError unless it is a whole number from 0 on."""
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise CmmError(f"a seed is a whole number from 0 on, got {seed!r}")
    return number
