"""Files of settings (TOML), such as scenarios and studies: reading, writing and error messages."""

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from dynamics.checks import shown
from dynamics.files import is_file, parse_toml, read_text
from identify.errors import IdentifyError

Settings = TypeVar("Settings", bound=BaseModel)


@dataclass(frozen=True)
class SettingsFiles(Generic[Settings]):
    """Files of one kind: built-in files by name, and files of the user by path.

    kind    Name of the kind, such as ``scenario``.
    folder  Folder of the package with the built-in files.
    model   Model of the content.
    error   Exception for a file that is refused, with the reason in one line.
    files   Keys whose values name files of another kind, each with the built-in names of that kind.
            Keys in tables are dotted. Such paths are relative to the file that states them.
    """

    kind: str
    folder: Path
    model: type[Settings]
    error: type[IdentifyError]
    files: Mapping[str, Callable[[], Collection[str]]] = dataclasses.field(default_factory=dict)

    def names(self) -> list[str]:
        """Return the names of the built-in files."""
        return sorted(path.stem for path in self.folder.glob("*.toml"))

    def load(self, name_or_path: str | Path) -> Settings:
        """Read a built-in file by name, or a file of the user by path.

        Raises the error of this kind if there is neither such a name (with the valid names) nor
        such a file, or if the file is not TOML or has wrong content.
        """
        text, path = self.text(name_or_path)
        built_in = path.parent == self.folder
        source = f"{self.kind} {path.stem!r}" if built_in else f"{self.kind} file {name_or_path}"
        return self.from_toml(text, source, path.parent)

    def text(self, name_or_path: str | Path) -> tuple[str, Path]:
        """Return the text and the path of a built-in file (by name) or a user's file (by path).

        Raises the same errors as `load`.
        """
        name = str(name_or_path)
        built_in = self.names()
        path = self.folder / f"{name}.toml" if name in built_in else Path(name)
        if not is_file(path):
            # The system raises errors for names with a null character and for long names.
            folder = "\0" not in name and len(name) < 200 and path.is_dir()
            reason = " nor a file" + ", but a folder" * folder
            raise self.error(
                f"{self.kind} {name[:200]!r} is neither built in ({', '.join(built_in)}){reason}"
            )
        return read_text(path, f"{self.kind} file {name}", self.error), path

    def from_toml(self, text: str, source: str, folder: Path = Path()) -> Settings:
        """Read settings from TOML text.

        ``source`` names the text in messages. Paths in the text are relative to ``folder``. Raises
        the same errors as `load`.
        """
        return self.from_dict(parse_toml(text, source, self.error), source, folder)

    def from_dict(self, content: Mapping[str, Any], source: str, folder: Path = Path()) -> Settings:
        """Read settings from nested mappings.

        An error names all wrong entries in one line. Raises the same errors as `load`.
        """
        try:
            return self.model.model_validate(self._placed(content, folder))
        except ValidationError as error:
            raise self.error(f"{source}: {one_line(error, self.model)}") from error

    def _placed(self, value: Any, folder: Path, key: str = "") -> Any:
        """Return the value at a dotted key, with its paths made absolute."""
        if isinstance(value, Mapping):
            return {
                name: self._placed(one, folder, f"{key}.{name}".lstrip("."))
                for name, one in value.items()
            }
        if isinstance(value, list):
            return [self._placed(one, folder, key) for one in value]
        names = self.files.get(key)
        return file_path(value, folder, names()) if names and isinstance(value, str) else value


def file_path(name: str, folder: Path, built_in: Collection[str]) -> str:
    """Return the absolute path of a file that is named relative to a folder.

    A built-in name is returned unchanged. So is a name that does not end with .toml and is no file,
    because the reader of the file then refuses it and lists the valid names.
    """
    path = folder / name
    if name in built_in or not (path.suffix == ".toml" or is_file(path)):
        return name
    return str(path.resolve())


def to_toml(model: BaseModel) -> str:
    """Return the TOML text of a two-level pydantic model, with units as comments.

    Plain values come first, and then a table for each section. A field with the value None has no
    TOML form. Its line is a comment with no value, which says what then holds.
    """
    return _text(model, lambda owner, name: "# " if getattr(owner, name) is None else "")


def starting_toml(model: BaseModel, only: Collection[str] | None = None) -> str:
    """Return TOML text as a template for a file.

    The text is that of `to_toml`, but a value that is not stated is commented out, and shows the
    default or no value. Only the given fields and sections are written, by default all of them.
    """
    return _text(model, lambda owner, name: "" if name in owner.model_fields_set else "# ", only)


def _text(
    model: BaseModel,
    before: Callable[[BaseModel, str], str],
    only: Collection[str] | None = None,
) -> str:
    """Return TOML text. ``before`` returns the prefix of a field's entry."""

    def entries(section: BaseModel) -> list[str]:
        fields = type(section).model_fields.items()
        return [f"{before(section, n)}{_entry(n, getattr(section, n), f)}" for n, f in fields]

    lines = []
    sections = []
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if only is not None and name not in only:
            continue
        if isinstance(value, BaseModel):
            sections += ["", f"[{name}]", *entries(value)]
        elif isinstance(value, dict):
            listed = [f"{key} = {_toml_value(one)}" for key, one in value.items()]
            sections += ["", f"[{name}]  # {field.description or ''}", *listed]
        else:
            lines.append(f"{before(model, name)}{_entry(name, value, field)}")
    return "\n".join(lines + sections) + "\n"


# Number of errors of one file that are listed. Further errors are only counted.
MOST_COMPLAINTS = 8

DOTTED = (
    "; a name with a dot must be in double quotes, and in a shell within single quotes: "
    """'key={"a.b"=0.1}'"""
)


VALID = "; valid names"  # between an unknown key and the list of valid ones


def one_line(error: ValidationError, model: type[BaseModel]) -> str:
    """Return all errors of a validation in one line.

    Each error has its key, value and unit. The valid names are listed once for all wrong names of a
    table.
    """
    errors = error.errors()
    complaints = []
    listed: set[str] = set()
    for details in errors[:MOST_COMPLAINTS]:
        complaint = _complaint(details, model)
        name, _, valid = complaint.partition(VALID)
        complaints.append(name if valid in listed else complaint)
        listed |= {valid} - {""}
    more = len(errors) - len(complaints)
    return "; ".join(complaints + ([f"and {more} more"] if more else []))


def _entry(name: str, value: Any, field: FieldInfo) -> str:
    unit = _unit(field)
    comment = f"{f'[{unit}]' if unit else ''} {field.description or ''}".strip()
    entry = f"{name} = {_toml_value(value)}" if value is not None else f"{name} ="
    return f"{entry:<40} # {comment}" if comment else entry


def _toml_value(value: Any) -> str:
    if isinstance(value, str):
        # JSON strings are TOML strings, except for the control character DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml_value(one) for one in value)}]"
    if isinstance(value, BaseModel):
        return _toml_value(dict(value))
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {_toml_value(one)}" for key, one in value.items())
        return f"{{{', '.join(entries)}}}"
    return repr(value).lower() if isinstance(value, bool) else repr(value)


def _complaint(details: ErrorDetails, model: type[BaseModel]) -> str:
    path = [str(part) for part in details["loc"]]
    key = ".".join(path)
    owner = _owner(path, model)
    fields = owner.model_fields if owner is not None else {}
    if details["type"] == "extra_forbidden":
        within = f" in [{'.'.join(path[:-1])}]" if len(path) > 1 else ""
        return f"unknown key {key!r}{VALID}{within}: {', '.join(fields)}"
    if details["type"] == "value_error":
        return f"{key}: {details['ctx']['error']}" if key else str(details["ctx"]["error"])
    if details["type"] == "missing":
        return f"{key} is missing"
    unit = f" [{u}]" if path and path[-1] in fields and (u := _unit(fields[path[-1]])) else ""
    message = details["msg"]
    # A dotted name without quotes is a table instead of a number.
    nested = isinstance(details["input"], dict) and details["type"] == "float_type"
    return (
        f"{key} = {shown(details['input'])}{unit}: "
        f"{message[0].lower()}{message[1:]}{DOTTED if nested else ''}"
    )


def _owner(path: list[str], model: type[BaseModel]) -> type[BaseModel] | None:
    """Return the model that has the field at the end of a path.

    A part of the path can be the key of a mapping to models.
    """
    owner: Any = model
    for part in path[:-1]:
        # In a mapping, this part of the path is a key chosen by the user, and names no field.
        if get_origin(owner) is dict:
            owner = get_args(owner)[1]
        elif (
            isinstance(owner, type) and issubclass(owner, BaseModel) and part in owner.model_fields
        ):
            owner = owner.model_fields[part].annotation
        else:
            return None
    return owner if isinstance(owner, type) and issubclass(owner, BaseModel) else None


def _unit(field: FieldInfo) -> str:
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""
