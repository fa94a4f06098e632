"""Command ``new``: commented starting files that work as they are, with a schema for editors."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.help import Command, Commands
from identify.commands.options import (
    Quiet,
    RobotArgument,
    built_in_folder,
    built_in_names,
    completion,
)
from identify.errors import OutputFolderError
from identify.files.atomic import write_files

NEW_HELP = """
Write a commented file to start from: a robot, sensor, scenario, study, or record.

Each works as it is. The first line of a TOML file names its JSON schema, by which editors complete
and check what is written. A file that is there already is never replaced.
"""

new = typer.Typer(
    name="new", cls=Commands, help=NEW_HELP, no_args_is_help=True, rich_markup_mode=None
)

File = Annotated[
    Path, typer.Argument(metavar="FILE.toml", help="File to write, which must not be there.")
]


def _like(kind: str) -> Any:
    names = ", ".join(built_in_names(kind))
    return typer.Option(
        "--like", help=f"Built-in {kind} to start from: {names}.", autocompletion=completion(kind)
    )


@new.command(cls=Command)
def robot(file: File, like: Annotated[str, _like("robot")] = "rss6", quiet: Quiet = False) -> None:
    """Write a robot file: geometry, parameter sets and gains of a built-in robot, under a name of
    your own.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new robot mine.toml --like ups6
      cmmsim check mine.toml
      cmmsim run quick --robot mine.toml
    """
    from dynamics.robot_file import read_robot_file

    _write({_toml(file): _copy("robot", like, file)}, read_robot_file)
    _say(quiet, file, f"judge it with: cmmsim check {file}")


@new.command(cls=Command)
def sensor(
    file: File, like: Annotated[str, _like("sensor")] = "ctrack780", quiet: Quiet = False
) -> None:
    """Write a sensor file: timing, cameras, light and stickers of a built-in sensor, under a name
    of your own.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new sensor mine.toml
      cmmsim acceptance mine.toml
      cmmsim run quick --set sensor=mine.toml
    """
    from cmmsim.files import read_sensor_file

    _write({_toml(file): _copy("sensor", like, file)}, read_sensor_file)
    _say(quiet, file, f"test it with: cmmsim acceptance {file}")


@new.command(cls=Command)
def scenario(
    file: File, like: Annotated[str, _like("scenario")] = "quick", quiet: Quiet = False
) -> None:
    """Write a scenario file with every key, its unit and its meaning; what holds without being said
    is commented out.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new scenario mine.toml --like paper
      cmmsim run mine.toml
    """
    from identify.scenario import load_scenario
    from identify.scenario.settings_file import starting_toml

    text = starting_toml(load_scenario(_known("scenario", like)))
    _write({_toml(file): _with_schema(_schema("scenario"), _named(text, file))}, load_scenario)
    _say(quiet, file, f"run it with: cmmsim run {file}")


@new.command(cls=Command)
def study(
    file: File,
    like: Annotated[
        str | None,
        typer.Option(
            "--like",
            help=f"Built-in study to start from: {', '.join(built_in_names('study'))}.",
            show_default="one that shows what a study may have",
            autocompletion=completion("study"),
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a study file: what is varied, over which values, what is drawn, and the laws that it
    should follow.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new study mine.toml
      cmmsim new study mine.toml --like frame_rate
      cmmsim study mine.toml
    """
    from identify.studies.study_file import STARTING, load_study

    starting = _with_schema(_schema("study"), _named(STARTING.read_text(encoding="utf-8"), file))
    _write({_toml(file): starting if like is None else _copy("study", like, file)}, load_study)
    _say(quiet, file, f"run it with: cmmsim study {file}")


@new.command(cls=Command)
def record(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="Table to write, which must not be there.")
    ],
    robot: RobotArgument = "rss6",
    quiet: Quiet = False,
) -> None:
    """Write an empty record of a robot of your own as CSV, and beside it the TOML file that goes
    with it.

    The table has the columns of this robot, comments that say what they hold and which rules a
    record keeps, and two rows at rest to show how one looks. The TOML file holds robot, timing,
    servo gains, what fixes the scale, and how exact the poses are.

    Reads a robot file. Writes FILE.csv and FILE.toml.

    \b
    Examples:
      cmmsim new record mine.csv ups6
      cmmsim identify --record mine.csv
    """
    from dynamics import load_robot
    from identify.record.own_record import (
        SCHEMA,
        description_file,
        description_text,
        read_own_records,
        table_text,
    )

    if file.suffix != ".csv":
        raise OutputFolderError(f"cannot write {file}: the name of a record's table ends in .csv")
    chosen = load_robot(robot)
    beside = description_file(file)
    # The path is absolute, because the description may be read from another folder.
    named = robot if robot in built_in_names("robot") else str(Path(robot).resolve())
    description = _with_schema(SCHEMA, description_text(chosen, named, file.name))
    _write({file: table_text(chosen), beside: description}, lambda path: read_own_records([path]))
    _say(quiet, file, f"fill in its rows and {beside}, then: cmmsim identify --record {file}")


def _known(kind: str, like: str) -> str:
    if like not in built_in_names(kind):
        raise OutputFolderError(
            f"unknown {kind} {like!r} after --like; valid: {', '.join(built_in_names(kind))}"
        )
    return like


def _copy(kind: str, like: str, file: Path) -> str:
    """Return the text of a built-in file under the name of another file."""
    text = (built_in_folder(kind) / f"{_known(kind, like)}.toml").read_text(encoding="utf-8")
    return _with_schema(_schema(kind), _named(text, file))


def _named(text: str, file: Path) -> str:
    """Replace the name in a TOML text by that of its file."""
    line = f"name = {json.dumps(file.stem)}"
    # A function, because re.sub would take backslashes in a text for references to groups.
    return re.sub(r"^name = .*$", lambda _: line, text, count=1, flags=re.MULTILINE)


def _schema(kind: str) -> Path:
    return built_in_folder(kind) / f"{kind}.schema.json"


def _with_schema(schema: Path, text: str) -> str:
    """Put a line before a TOML text that tells editors its schema, that of this installation."""
    return f"#:schema {schema.resolve().as_uri()}\n{text}"


def _toml(file: Path) -> Path:
    if file.suffix != ".toml" or not re.fullmatch(r"[\w.-]+", file.stem):
        raise OutputFolderError(
            f"cannot write {file}: its name must end in .toml, and have letters, digits, dots, _ "
            "and - before that"
        )
    return file


def _write(texts: Mapping[Path, str], read: Callable[[Path], Any]) -> None:
    """Write files of one folder that are not there yet: all of them, or none.

    The first one must be readable by `read`. Raises OutputFolderError if a file is there, and the
    errors of `read`, such as for an impossible name.
    """
    for path in texts:
        if path.exists():
            raise OutputFolderError(
                f"{path} is there already, and is not replaced; name another file, or remove it"
            )
    write_files({path: text.encode() for path, text in texts.items()}, parents=True, check=read)


def _say(quiet: bool, file: Path, further: str) -> None:
    if not quiet:
        typer.echo(f"{file}; {further}")
