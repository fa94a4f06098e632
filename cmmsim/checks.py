"""Checks of arguments and of entries in TOML files.

A value is either accepted, or refused with a message that states the value and what is required.
"""

import operator
import re
import tomllib
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from cmmsim.errors import CmmError, ShapeError

# Largest number of characters of a refused value in a message.
SHOWN_CHARACTERS = 120
# Largest number of bytes of a file. People write far smaller files, and larger ones take long to
# read.
LARGEST = 500_000
# Largest nesting depth of tables and lists, and largest number of parts of a dotted key.
DEEPEST = 16
TOO_DEEP = f"keys, tables or lists more than {DEEPEST} deep"
# Names of sensors become file names. A file name has at most 255 bytes, and one letter of some
# scripts takes 4 bytes.
NAME = r"^\w[\w .+-]*$"
LONGEST_NAME = 60
# Largest number of problems of one file in a message.
MOST_COMPLAINTS = 8
VALID = ", valid are "  # between an unknown key and the list of valid ones
# Control characters other than tab and newline.
_UNWANTED = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")
# Pattern of strings and comments of TOML. It never backtracks, so a search takes linear time.
_TEXTS = re.compile(
    r"""
    \"{3} (?: [^"\\] | \\. | "(?!"") )*+ (?: \"{3} | \Z )  # a text over several lines
    | " (?: [^"\\\n] | \\. )*+ "?
    | '{3} (?: [^'] | '(?!'') )*+ (?: '{3} | \Z )
    | ' [^'\n]*+ '?
    | \# [^\n]*+
    """,
    re.DOTALL | re.VERBOSE,
)


def finite_array(values: ArrayLike, shape: tuple[int, ...], wanted: str) -> NDArray[np.float64]:
    """Return values as an array of the given shape.

    Raises ShapeError for another shape, and for values that are not finite real numbers. The
    message begins with ``wanted``, a sentence that states what is required.
    """
    try:
        array = np.asarray(values)
        numbers = array.astype(float) if array.dtype.kind in "fiubO" else None
    except (TypeError, ValueError, OverflowError):  # ragged lists, or objects that are not numbers
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
    """Raise CmmError unless a value is of type ``kind``. The message begins with ``wanted``."""
    if not isinstance(value, kind):
        raise CmmError(f"{wanted}, got {_shown(value)} of type {type(value).__name__}")


class Section(BaseModel):
    """Section of a TOML file.

    Unknown keys and numbers that are not finite are refused. Entries cannot be changed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


def check_name(name: str) -> str:
    """Return the name. Raises ValueError if it cannot be a file name."""
    if re.fullmatch(NAME, name) and len(name) <= LONGEST_NAME:
        return name
    raise ValueError(
        f"{name[: LONGEST_NAME + 1]!r} must be at most {LONGEST_NAME} letters, digits, spaces and "
        ". _ + -, beginning with a letter, a digit or _"
    )


def read_text(path: str | Path, source: str, error_class: type[CmmError]) -> str:
    """Return the text of a file.

    ``source`` names the file in messages, such as "board file x". Raises ``error_class`` if the
    file cannot be read, has more than `LARGEST` bytes, or is not UTF-8 text.
    """
    try:
        location = Path(path)
        if location.exists() and not (location.is_file() or location.is_dir()):
            raise error_class(f"cannot read {source}: it is not a regular file")
        with location.open("rb") as file:
            content = file.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise error_class(f"{source} has more than {LARGEST:,} bytes, which is the limit")
        return content.decode("utf-8")
    except OSError as error:
        raise error_class(f"cannot read {source}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise error_class(f"{source} is not text, so it cannot be TOML: {error}") from error


def parsed(text: str, source: str, error_class: type[CmmError]) -> dict[str, Any]:
    """Return the content of a TOML text as a new dictionary, which the caller is free to change.

    Raises ``error_class`` if the text is not TOML, nests tables deeper than `DEEPEST`, or contains
    integers beyond 64 bits, dates, times or control characters.
    """
    try:
        return deepcopy(_parsed(text))
    except tomllib.TOMLDecodeError as error:
        raise error_class(f"{source} is not TOML: {error}") from error
    except RecursionError:
        raise error_class(f"{source} has {TOO_DEEP}") from None
    except ValueError as error:
        raise error_class(f"{source} has {error}") from error


def checked(model: type[M], content: dict[str, Any], source: str, error_class: type[CmmError]) -> M:
    """Return the content of a file as an instance of ``model``.

    Raises ``error_class`` for content that does not match. The message lists at most
    `MOST_COMPLAINTS` problems and, for an unknown key, the valid keys.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = error.errors()
        shown: list[str] = []
        listed: set[str] = set()
        for details in problems[:MOST_COMPLAINTS]:
            problem = _explain(details, model)
            # the valid keys of a section are listed once
            key, _, valid = problem.partition(VALID)
            shown.append(key if valid in listed else problem)
            listed |= {valid} - {""}
        more = len(problems) - len(shown)
        shown += [f"and {more} more"] if more else []
        raise error_class(f"{source}: {'; '.join(shown)}") from error


@lru_cache(maxsize=8)
def _parsed(text: str) -> dict[str, Any]:
    """Parse a TOML text. Raises ValueError, whose message names the content that is refused.

    The result is cached, because a study reads the same sensor file for every row. Otherwise,
    parsing would take an eighth of the computing time per row.
    """
    pieces = re.split(r"[=,\[\]{}\n]", _TEXTS.sub("_", text))
    # The time that tomllib takes grows with the square of the number of parts of a dotted key, so
    # the parts are counted first.
    if any(piece.count(".") >= DEEPEST for piece in pieces):
        raise ValueError(TOO_DEEP)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # int() refuses numbers of some thousand digits
        raise ValueError("an integer beyond 64 bits, or an impossible date") from None
    if fault := _fault(content):
        raise ValueError(fault)
    return content


def _fault(content: dict[str, Any]) -> str:
    """Return a text that names a value that no file may contain, or an empty text."""
    unvisited: list[tuple[Any, int]] = [(content, 0)]
    while unvisited:
        value, depth = unvisited.pop()
        if depth > DEEPEST:
            return TOO_DEEP
        if isinstance(value, dict):
            unvisited += [(key, depth) for key in value]
            unvisited += [(entry, depth + 1) for entry in value.values()]
        elif isinstance(value, list):
            unvisited += [(entry, depth + 1) for entry in value]
        elif isinstance(value, str) and _UNWANTED.search(value):
            return f"a control character in {value[:60]!r}"
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            return "an integer beyond 64 bits"
        elif not isinstance(value, (str, int, float)):
            return f"a date or time, {value}, which is not allowed"
    return ""


def _explain(error: Any, model: type[BaseModel]) -> str:
    """Describe one problem that pydantic found."""
    where = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"unknown key {where!r}{VALID}{', '.join(_valid_keys(error['loc'][:-1], model))}"
    if error["type"] == "missing":
        return f"{where}: {error['msg']}"  # the input, the whole section, is not shown
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    return f"{where}: {error['msg']} (got {_shown(repr(error['input']))})"


def _valid_keys(section: tuple[Any, ...], model: Any) -> list[str]:
    """Return the valid keys of a section of ``model``. The keys ``section`` lead to it."""
    for part in section:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        model = getattr(annotation, "__args__", (annotation,))[0]
    return sorted(model.model_fields)


def _shown(values: object) -> str:
    """Show values on one line, shortened to `SHOWN_CHARACTERS`."""
    text = " ".join(str(values).split())
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def checked_seed(seed: int) -> int:
    """Return the seed. Raises CmmError unless it is a whole number, 0 or more."""
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if number < 0:
        raise CmmError(f"a seed must be a whole number, 0 or more, got {seed!r}")
    return number
