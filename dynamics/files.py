"""Reading of files from users. Files beyond some limits are refused with a short message.

The limits far exceed what a person writes. They are low enough that any file of at most a megabyte
is read or refused within seconds.
"""

import json
import re
import tomllib
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree as Xml

import yaml
from pydantic import AfterValidator, WithJsonSchema

LARGEST = 500_000  # largest size of a TOML file, in bytes, and of its text, in characters
LARGEST_XML = 1_000_000  # largest size of an XML file, in bytes
DEEPEST = 16  # largest depth of tables and lists, and largest number of parts of a dotted key
DEEPEST_ELEMENT = 150  # largest depth of XML elements
LARGEST_YAML = 100_000  # largest size of a YAML file, in bytes
# Pattern of the names of robots, sensors, scenarios and studies, which are used as file names.
NAME = r"^\w[\w .+-]*$"
# Largest number of characters of a name. Its file name then has at most 255 bytes.
LONGEST_NAME = 60

_YamlLoader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
# Control characters other than tab and line feed.
_UNWANTED = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")
# Strings and comments in TOML. Matches do not backtrack, so that a search takes linear time.
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


def is_name(name: str) -> bool:
    """Return True if a name can be used as a file name."""
    return bool(re.fullmatch(NAME, name)) and len(name) <= LONGEST_NAME


def check_name(name: str) -> str:
    """Return the name. Raises ValueError for a name that cannot be used as a file name."""
    if is_name(name):
        return name
    raise ValueError(
        f"{name[: LONGEST_NAME + 1]!r} must be at most {LONGEST_NAME} letters, digits, spaces and "
        ". _ + -, beginning with a letter, a digit or _"
    )


# Name that is used as a file name.
Name = Annotated[
    str,
    AfterValidator(check_name),
    WithJsonSchema({"type": "string", "pattern": NAME, "maxLength": LONGEST_NAME}),
]


def is_file(path: str | PathLike[str]) -> bool:
    """Return True if a path is a file. An invalid path, such as one with NUL, is no file."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def read_bytes(
    path: str | PathLike[str], source: str, error_class: type[Exception], largest: int = LARGEST
) -> bytes:
    """Content of a file. `source` is its name in messages, such as "robot file mine.toml".

    Raises `error_class`, with the reason, for a file that cannot be read or is too large.
    """
    try:
        file_path = Path(path)
        if file_path.exists() and not (file_path.is_file() or file_path.is_dir()):
            raise error_class(f"cannot read {source}: it is not a regular file")
        with file_path.open("rb") as file:
            content = file.read(largest + 1)
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise error_class(f"cannot read {source}: {reason}") from error
    if len(content) > largest:
        raise error_class(f"{source} has more than {largest:,} bytes, the limit for such files")
    return content


def read_text(path: str | PathLike[str], source: str, error_class: type[Exception]) -> str:
    """Text of a file in UTF-8. Raises `error_class` like `read_bytes`, and for other encodings."""
    try:
        return read_bytes(path, source, error_class).decode("utf-8")
    except UnicodeDecodeError as error:
        raise error_class(f"cannot read {source}: {error}") from error


def parse_toml(text: str, source: str, error_class: type[Exception]) -> dict[str, Any]:
    """Content of TOML text. `source` is its name in messages.

    Raises `error_class` for text that is not TOML or has more than `LARGEST` characters, for keys,
    tables and lists deeper than `DEEPEST`, for integers beyond 64 bits, for dates, and for control
    characters.
    """
    if len(text) > LARGEST:
        raise error_class(
            f"{source} has more than {LARGEST:,} characters, the limit for such files"
        )
    deep = f"{source} has keys, tables or lists more than {DEEPEST} deep"
    bare = re.split(r"[=,\[\]{}\n]", _TEXTS.sub("_", text))
    # the time of tomllib grows with the square of the number of parts of a dotted key
    if any(key.count(".") >= DEEPEST for key in bare):
        raise error_class(deep)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise error_class(f"{source} is not valid TOML: {error}") from error
    except RecursionError:
        raise error_class(deep) from None
    except ValueError:
        # int() refuses numbers with more than a few thousand digits
        raise error_class(f"{source} has an integer beyond 64 bits, or an invalid date") from None
    fault = _fault(content)
    if fault:
        raise error_class(f"{source} has {fault}")
    return content


def _fault(content: dict[str, Any]) -> str:
    """Text on an entry that exceeds the limits, or an empty text if there is none."""
    pending: list[tuple[Any, int]] = [(content, 0)]
    while pending:
        value, depth = pending.pop()
        if depth > DEEPEST:
            return f"keys, tables or lists more than {DEEPEST} deep"
        if isinstance(value, dict):
            pending += [(key, depth) for key in value]
            pending += [(item, depth + 1) for item in value.values()]
        elif isinstance(value, list):
            pending += [(item, depth + 1) for item in value]
        elif isinstance(value, str) and _UNWANTED.search(value):
            return f"a control character in {value[:60]!r}"
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            return "an integer beyond 64 bits"
        elif not isinstance(value, (str, int, float)):
            return f"a date or time, {value}, which is not allowed"
    return ""


def parse_json(text: str, source: str, error_class: type[Exception]) -> Any:
    """Content of JSON text.

    Raises `error_class` for text that is not JSON, is too deep, or has integers with too many
    digits.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = "it is too deep" if isinstance(error, RecursionError) else error
        raise error_class(f"{source} is truncated or not JSON: {reason}") from error


def parse_yaml(content: bytes, source: str, error_class: type[Exception]) -> Any:
    """Content of YAML text with mappings, lists and names. Every scalar is returned as text.

    Raises `error_class` for content that is not YAML, for aliases, for a key that occurs twice in a
    mapping, and for more than `DEEPEST` levels.
    """
    try:
        _check_events(yaml.parse(content, Loader=_YamlLoader), source, error_class)
        _check_keys(yaml.compose(content, Loader=_YamlLoader), source, error_class)
        return yaml.load(content, Loader=_YamlLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise error_class(f"cannot read {source}: {' '.join(str(error).split())}") from None


def _check_events(events: Iterable[Any], source: str, error_class: type[Exception]) -> None:
    """Raise `error_class` for aliases and for content that is too deep."""
    depth = 0
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            raise error_class(f"{source} has an alias, *{event.anchor}; write its content instead")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise error_class(f"{source} has lists and mappings more than {DEEPEST} deep")


def _check_keys(node: yaml.Node | None, source: str, error_class: type[Exception]) -> None:
    """Raise `error_class`, with line and key, for a key that occurs twice in a mapping."""
    if isinstance(node, yaml.MappingNode):
        keys = set()
        for key, value in node.value:
            name = str(key.value)
            if name in keys:
                line = key.start_mark.line + 1
                raise error_class(f"{source} line {line} has the key {name[:60]!r} twice")
            keys.add(name)
            _check_keys(value, source, error_class)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(item, source, error_class)


def parse_xml(content: bytes, source: str, error_class: type[Exception]) -> Xml.Element:
    """Root element of XML.

    Raises `error_class` for content that is not XML, for elements more than `DEEPEST_ELEMENT` deep,
    and for a document type, which could define entities.
    """
    try:
        return Xml.fromstring(content, Xml.XMLParser(target=_Builder()))
    except (Xml.ParseError, ValueError) as error:
        raise error_class(f"cannot read {source}: {error}") from None


class _Builder(Xml.TreeBuilder):
    """Builder of an XML tree within limits. Raises ValueError beyond them."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(
            "it declares a document type, which is not allowed: it could define entities"
        )

    def start(self, tag: Any, attrs: Any, /) -> Xml.Element:
        self._depth += 1
        if self._depth > DEEPEST_ELEMENT:
            raise ValueError(f"its elements are more than {DEEPEST_ELEMENT} deep")
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> Xml.Element:
        self._depth -= 1
        return super().end(tag)
