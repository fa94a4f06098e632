"""Command ``new``: commented template files that work without changes, with editor schemas."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.help import Command, Commands
from identify.commands.new_files import (
    copy_of,
    known,
    renamed,
    say,
    schema_of,
    toml_file,
    with_schema,
    write_new,
)
from identify.commands.options import (
    Quiet,
    RobotArgument,
    built_in_names,
    completion,
    robot_option,
)
from identify.errors import OutputFolderError

NEW_HELP = """
Write a commented file to start from: a robot, sensor, scenario, study, or record.

Each file works without changes. The first line of a TOML file names its JSON schema, which editors
use to complete and check the keys. An existing file is never replaced.
"""

new = typer.Typer(
    name="new", cls=Commands, help=NEW_HELP, no_args_is_help=True, rich_markup_mode=None
)

File = Annotated[
    Path, typer.Argument(metavar="FILE.toml", help="File to write. It must not exist yet.")
]


def _like(kind: str) -> Any:
    names = ", ".join(built_in_names(kind))
    return typer.Option(
        "--like", help=f"Built-in {kind} to start from: {names}.", autocompletion=completion(kind)
    )


def _length(what: str) -> Any:
    return typer.Option(metavar="M", help=f"{what}, m.", show_default="as it was")


Length = float | None

PROBABLY_MM = 20.0  # length, m, from which the message about an impossible robot asks for the unit


@new.command(cls=Command)
def robot(
    file: File,
    like: Annotated[str, _like("robot")] = "rss6",
    base_radius: Annotated[Length, _length("From the middle to the base joints, in plan")] = None,
    platform_radius: Annotated[
        Length, _length("From the middle of the platform to its joints, in plan")
    ] = None,
    crank: Annotated[Length, _length("Length of a crank")] = None,
    link: Annotated[Length, _length("Length of a link")] = None,
    bar_distance: Annotated[Length, _length("Between the two bars of a parallelogram")] = None,
    leg: Annotated[Length, _length("Length of a leg of cylinder and rod at home")] = None,
    cylinder: Annotated[Length, _length("Length of a cylinder")] = None,
    rod: Annotated[Length, _length("Length of a rod")] = None,
    quiet: Quiet = False,
) -> None:
    """Write a robot file: geometry, parameter sets and gains of a built-in robot, under a name of
    your own and with lengths of your own.

    Without lengths, the file is a copy, comments included, but in [unstated] it has the standard
    deviations of a workshop. With lengths, joints, home, directions and travel follow from them,
    masses and inertias are scaled, and the gains of the drives are designed. Lengths that are not
    given stay as they are. A family has its own lengths: robots with cranks have base-radius,
    platform-radius, crank and link, delta3 also bar-distance; those with sliders have base-radius,
    platform-radius and link; ups6 has base-radius, platform-radius, leg, cylinder and rod.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new robot mine.toml --like ups6
      cmmsim new robot mine.toml --like rss6 --base-radius 0.25 \\
        --platform-radius 0.15 --crank 0.08 --link 0.25
      cmmsim check mine.toml
      cmmsim run quick --robot mine.toml
    """
    from dynamics.errors import RobotFileError
    from dynamics.robot_file import read_robot_file

    given = {
        "base_radius": base_radius,
        "platform_radius": platform_radius,
        "crank": crank,
        "link": link,
        "bar_distance": bar_distance,
        "leg": leg,
        "cylinder": cylinder,
        "rod": rod,
    }
    lengths = {name: value for name, value in given.items() if value is not None}
    try:
        resized = _of_lengths(file, like, lengths) if lengths else None
        text = resized or _of_a_workshop(copy_of("robot", like, file))
        write_new({toml_file(file): text}, read_robot_file)
    except RobotFileError as error:
        large = [
            f"{name.replace('_', '-')} {value:g} m"
            for name, value in lengths.items()
            if value >= PROBABLY_MM
        ]
        if large:
            raise RobotFileError(
                f"cannot write {file}: lengths are in m: {', '.join(large)}; are they in mm?"
            ) from error
        raise
    say(quiet, file, f"judge it with: cmmsim check {file}")


@new.command(cls=Command)
def sensor(
    file: File,
    like: Annotated[str, _like("sensor")] = "ctrack780",
    robot: Annotated[str | None, robot_option("Robot that the sensor is to see.", "none")] = None,
    quiet: Quiet = False,
) -> None:
    """Write a sensor file: timing, cameras, light and stickers of a built-in sensor, under a name
    of your own.

    With --robot, the file has the robot's home, a platform on which its legs end, and cameras that
    see all stickers of the built-in sensor at home. For legs that come from above, platform and
    cameras are upside down. The file states these alone; the built-in sensor supplies the rest.

    Reads a robot file, if one is named. Writes one TOML file.

    \b
    Examples:
      cmmsim new sensor mine.toml
      cmmsim new sensor mine.toml --robot pss6
      cmmsim acceptance mine.toml
      cmmsim run quick --set sensor=mine.toml
    """
    from cmmsim.files import read_sensor_file

    if robot is None:
        write_new({toml_file(file): copy_of("sensor", like, file)}, read_sensor_file)
        say(quiet, file, f"test it with: cmmsim acceptance {file}")
        return
    from dynamics import load_robot
    from identify.experiment.fitted_sensor import fitted, fitted_text

    basis = read_sensor_file(known("sensor", like))
    if basis.based_on is not None:
        raise OutputFolderError(f"--robot needs a sensor such as {basis.based_on} after --like")
    text = fitted_text(fitted(basis, load_robot(robot)), toml_file(file).stem, like)
    write_new({file: with_schema(schema_of("sensor"), text)}, read_sensor_file)
    say(quiet, file, f"look with: cmmsim show {robot} {file}")


@new.command(cls=Command)
def scenario(
    file: File, like: Annotated[str, _like("scenario")] = "quick", quiet: Quiet = False
) -> None:
    """Write a scenario file with every key, its unit and its meaning; keys at their default values
    are commented out.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new scenario mine.toml --like paper
      cmmsim run mine.toml
    """
    from identify.scenario import load_scenario
    from identify.scenario.settings_file import starting_toml

    text = starting_toml(load_scenario(known("scenario", like)))
    write_new(
        {toml_file(file): with_schema(schema_of("scenario"), renamed(text, file))}, load_scenario
    )
    say(quiet, file, f"run it with: cmmsim run {file}")


@new.command(cls=Command)
def study(
    file: File,
    like: Annotated[
        str | None,
        typer.Option(
            "--like",
            help=f"Built-in study to start from: {', '.join(built_in_names('study'))}.",
            show_default="an example with all keys",
            autocompletion=completion("study"),
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a study file: the factors and their values, the plots, and the laws that the results
    should follow.

    Reads nothing of yours. Writes one TOML file.

    \b
    Examples:
      cmmsim new study mine.toml
      cmmsim new study mine.toml --like frame_rate
      cmmsim study mine.toml
    """
    from identify.studies.study_file import STARTING, load_study

    starting = with_schema(schema_of("study"), renamed(STARTING.read_text(encoding="utf-8"), file))
    write_new(
        {toml_file(file): starting if like is None else copy_of("study", like, file)}, load_study
    )
    say(quiet, file, f"run it with: cmmsim study {file}")


@new.command(cls=Command)
def record(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.csv", help="Table to write. It must not exist yet.")
    ],
    robot: RobotArgument = "rss6",
    logs: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="LOG",
            help="Log of your own, from whose header [columns] is proposed: a CSV table, an export "
            "of Motive or Vicon, or a bag of ROS 2. Repeat the option for a second log with the "
            "commands.",
            show_default=False,
        ),
    ] = None,
    body: Annotated[
        str | None,
        typer.Option("--body", help="Body of the platform, where a log has several."),
    ] = None,
    commands: Annotated[
        str | None,
        typer.Option("--commands", help="Columns of the commands, where a log has several."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a template for a record of your own: a CSV table, and a TOML file that describes it.

    The table has the columns of this robot, comments that explain the columns and the rules of a
    record, and two example rows at rest. The TOML file holds the robot, timing, servo gains, the
    quantity that fixes the scale, and the uncertainty of the poses.

    With --from, no table is written. The TOML file then also says what the columns of your log are
    called, and in which units and conventions they are. Whatever the header does not tell is "?",
    which you replace.

    Reads a robot file, and your logs. Writes FILE.csv and FILE.toml.

    \b
    Examples:
      cmmsim new record mine.csv ups6
      cmmsim new record mine.csv ups6 --from take.csv --from commands.csv
      cmmsim identify --record mine.csv
    """
    from dynamics import load_robot
    from dynamics.files import parse_toml
    from identify.errors import RecordError
    from identify.record.own_record import description_file, is_log, read_own_records
    from identify.record.record_template import (
        FRAME_RATE_HZ,
        SCHEMA,
        columns_text,
        description_text,
        proposed,
        table_text,
    )

    if file.suffix != ".csv" and not (logs and is_log(file)):
        raise OutputFolderError(
            f"cannot write {file}: the name of a record's table must end in .csv"
        )
    chosen = load_robot(robot)
    beside = description_file(file)
    if file.exists() and not logs:
        raise OutputFolderError(
            f"{file} exists already and is not replaced; if it is your log, describe it with: "
            f"cmmsim new record {file} {robot} --from {file}"
        )
    # The path is absolute, because the description may be read from another folder.
    named = robot if robot in built_in_names("robot") else str(Path(robot).resolve())
    if logs:
        proposal = proposed(logs, file, chosen, body, commands)
        head = description_text(chosen, named, file.name, proposal.rate_hz or FRAME_RATE_HZ)
        text = with_schema(SCHEMA, f"{head}{proposal.text}")
        write_new({beside: text}, lambda path: parse_toml(path.read_text(), str(path), RecordError))
        asked = f"answer {', '.join(proposal.asked)} in it, " if proposal.asked else ""
        say(quiet, beside, f"{asked}fill in the rest, then: cmmsim check {file}")
        return
    text = description_text(chosen, named, file.name) + columns_text()
    description = with_schema(SCHEMA, text)
    write_new(
        {file: table_text(chosen), beside: description}, lambda path: read_own_records([path])
    )
    say(quiet, file, f"fill in its rows and {beside}, then: cmmsim identify --record {file}")


def _of_lengths(file: Path, like: str, lengths: Mapping[str, float]) -> str:
    """Return the text of a robot file with other lengths, m, and gains for two frame rates."""
    from dynamics import load_robot
    from dynamics.robot_lengths import lengths_of, robot_of_lengths
    from dynamics.robot_text import robot_text
    from identify.loop_parameters import loop_settings
    from identify.scenario import load_scenario

    chosen = load_robot(known("robot", like))
    valid = [_option(name) for name in lengths_of(chosen.geometry)]
    for name in map(_option, lengths):
        if name not in valid:
            raise OutputFolderError(f"{like} has no length {name}; valid: {', '.join(valid)}")
    given = load_scenario("paper")
    slower = given.timing.model_copy(update={"frame_rate_hz": 29.0, "latency_s": 1 / 29})
    loops = [
        loop_settings(chosen, given.servo, timing, given.control, given.plant)
        for timing in (given.timing, slower)
    ]
    resized, comments = robot_of_lengths(toml_file(file).stem, chosen, lengths, loops)
    return with_schema(schema_of("robot"), robot_text(resized, comments))


def _option(length: str) -> str:
    """Return the option that sets a length."""
    return f"--{length.replace('_', '-')}"


def _of_a_workshop(text: str) -> str:
    """Return the text of a built-in robot file with bodies and joints known as in a workshop."""
    from dynamics.parameter_set import Unstated

    for name, std in Unstated():
        text = re.sub(rf"^{name} = 0\.0 *#", f"{name} = {std}  #", text, flags=re.MULTILINE)
    return re.sub(
        "^# Bodies and joints are exactly as .*$",
        "# How far bodies and joints can be from their model: standard deviations, those of an "
        "ordinary workshop.\n# They widen the intervals of an identification. 0 is for a robot "
        "that is exactly as this file says.",
        text,
        flags=re.MULTILINE,
    )
