"""New files that start from built-in ones. They are checked before they are put in place."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer

from identify.commands.options import built_in_folder, built_in_names
from identify.errors import OutputFolderError
from identify.files.atomic import write_files


def known(kind: str, like: str) -> str:
    """Return the name of a built-in file. Raises OutputFolderError for any other name."""
    if like not in built_in_names(kind):
        raise OutputFolderError(
            f"unknown {kind} {like!r} after --like; valid: {', '.join(built_in_names(kind))}"
        )
    return like


def copy_of(kind: str, like: str, file: Path) -> str:
    """Return the text of a built-in file under the name of another file."""
    text = (built_in_folder(kind) / f"{known(kind, like)}.toml").read_text(encoding="utf-8")
    return with_schema(schema_of(kind), renamed(text, file))


def renamed(text: str, file: Path) -> str:
    """Set the key `name` of a TOML text to the name of its file."""
    line = f"name = {json.dumps(file.stem)}"
    # The replacement is a function, because re.sub would interpret backslashes in a string.
    return re.sub(r"^name = .*$", lambda _: line, text, count=1, flags=re.MULTILINE)


def schema_of(kind: str) -> Path:
    """Return the JSON schema of a kind of files."""
    return built_in_folder(kind) / f"{kind}.schema.json"


def with_schema(schema: Path, text: str) -> str:
    """Put a line that names a schema of this installation before a TOML text."""
    return f"#:schema {schema.resolve().as_uri()}\n{text}"


def toml_file(file: Path) -> Path:
    """Return a file whose name can be that of a robot. Raises OutputFolderError for any other."""
    if file.suffix != ".toml" or not re.fullmatch(r"[\w.-]+", file.stem):
        raise OutputFolderError(
            f"cannot write {file}: its name must end in .toml, and consist of letters, digits, "
            "dots, _ and -"
        )
    return file


def write_new(texts: Mapping[Path, str], read: Callable[[Path], Any]) -> None:
    """Write new files into one folder: all of them, or none.

    `read` checks the first file. Raises OutputFolderError if a file exists, and the errors of
    `read`, for example for an invalid name.
    """
    for path in texts:
        if path.exists():
            raise OutputFolderError(
                f"{path} exists already and is not replaced; name another file, or remove it"
            )
    first = next(iter(texts))

    def check(temporary: Path) -> None:
        try:
            read(temporary)
        except Exception as error:
            # The user knows the file by the name that it will have.
            error.args = (str(error).replace(temporary.name, first.name),)
            raise

    write_files({path: text.encode() for path, text in texts.items()}, parents=True, check=check)


def say(quiet: bool, file: Path, further: str) -> None:
    """Print the file that was written, and what to do next, unless `quiet`."""
    if not quiet:
        typer.echo(f"{file}; {further}")
