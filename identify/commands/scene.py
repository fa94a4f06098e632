"""Commands that replay a run on an HTML page, and that show a robot and a sensor at home."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from identify.commands.kinds_of_files import KEYS
from identify.commands.options import Plugins, Quiet
from identify.errors import OutputFolderError, ScenarioError
from identify.progress import print_warnings, terminal_progress

if TYPE_CHECKING:
    from identify.scene import Workcell

PICTURES = (".png", ".pdf", ".svg")
PAGES = (".html", ".htm")
SENSOR = "ctrack780"  # shown with a robot that is named alone


def replay(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run that has been recorded.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="File to write.", show_default="RUN/replay.html"
        ),
    ] = None,
    motion: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="Motion to show: excitation, or a validation run such as run01."
        ),
    ] = "excitation",
    renderer: Annotated[
        str | None,
        typer.Option(
            help="Renderer of the camera images, as in the scenario.",
            show_default="that of the run, or analytic for a run without images",
        ),
    ] = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Show a run as one HTML page that opens without a network.

    The page shows the robot, stickers and cameras in space, the images of both cameras, and the
    measured, true and modelled poses over time, with enlarged differences. Open it in a browser.

    Reads the files of a run that has been recorded. Writes RUN/replay.html.

    \b
    Examples:
      cmmsim replay runs/quick-0
      cmmsim replay runs/quick-0 --motion run01   first validation trajectory
    """
    from identify.scene import read_motion, write_page

    path = out or run / "replay.html"
    shown = read_motion(run, motion, renderer)
    write_page(path, shown, terminal_progress(quiet))
    print_warnings(shown.notes)
    if not quiet:
        typer.echo(f"replay: {path}")


def show(
    names: Annotated[
        list[str], typer.Argument(metavar="NAME|FILE", help="A robot, a sensor, or one of each.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Page to write.", show_default="NAME.html"),
    ] = None,
    png: Annotated[
        Path | None,
        typer.Option(
            "--png",
            metavar="FILE",
            help="Write a picture for print in place of the page: .png, .pdf or .svg.",
        ),
    ] = None,
    renderer: Annotated[
        str,
        typer.Option(
            help="Renderer of the camera images: analytic, or pyrender or scene, which need OpenGL."
        ),
    ] = "analytic",
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Show a robot and a sensor at the home pose, as one HTML page or as a picture.

    A robot is shown with the sensor that is named with it. Without such a name it is shown with
    ctrack780, if the platform of that sensor fits. The page opens without a network.

    Reads the file of a robot, of a sensor, or of both. Writes NAME.html, or a picture for print.

    \b
    Examples:
      cmmsim show ups6
      cmmsim show mine.toml cameras.toml          a robot and a sensor of your own
      cmmsim show rss6 --png scene.pdf            a picture: .png, .pdf or .svg
    """
    from identify.scene import motion_at_home, write_page

    if png is not None and png.suffix not in PICTURES:
        raise OutputFolderError(
            f"--png {png} ends in {png.suffix or 'nothing'}; valid: {', '.join(PICTURES)}"
        )
    if out is not None and out.suffix not in PAGES:
        raise OutputFolderError(
            f"--out {out} ends in {out.suffix or 'nothing'}, but writes a page; valid: "
            f"{', '.join(PAGES)}; a picture is written by --png {out}"
        )
    cell, notes = chosen_cell(names)
    print_warnings(notes)
    if png is not None:
        write_picture(png, cell, renderer)
    path = out or (None if png else Path(f"{Path(names[0]).stem}.html"))
    if path is not None:
        standing = motion_at_home(cell, renderer)
        standing.notes.extend(notes)
        write_page(path, standing, terminal_progress(quiet))
    if not quiet:
        for what, file in (("picture", png), ("page", path)):
            if file is not None:
                typer.echo(f"{what}: {file}")


def write_picture(path: Path, cell: "Workcell", renderer: str) -> None:
    """Draw the scene and, with a sensor, the camera images into a file. Raises WriteError."""
    from identify.files.atomic import check_writable, figure_bytes, write_bytes
    from identify.scene import overview_figure, scene_figure, stereo_view

    check_writable(path)
    if cell.sensor is None:
        figure = scene_figure(cell)
    else:
        figure = overview_figure(cell, stereo_view(cell, renderer=renderer))
    write_bytes(path, figure_bytes(figure, path.suffix, dpi=200), parents=True)


def chosen_cell(names: list[str]) -> tuple["Workcell", list[str]]:
    """Return the robot and sensor of one or two names or files, and notes for the user.

    Raises ScenarioError if two robots or two sensors are named, a file is neither robot nor sensor,
    or robot and sensor do not fit each other. Raises RobotFileError or CmmError if a file cannot be
    used.
    """
    from cmmsim.files import read_sensor_file
    from dynamics import load_robot
    from identify.scene import workcell

    kinds = [kind_of(name) for name in names]
    if len(set(kinds)) < len(kinds):
        raise ScenarioError(
            f"show takes a robot, a sensor, or one of each; {' and '.join(names)} are {kinds[0]}s"
        )
    robot = next(
        (load_robot(name) for name, kind in zip(names, kinds, strict=True) if kind == "robot"), None
    )
    named = next((name for name, kind in zip(names, kinds, strict=True) if kind == "sensor"), None)
    if robot is None or named is not None:
        return workcell(robot, None if named is None else read_sensor_file(named)), []
    # The user named no sensor, so a robot that does not fit the default sensor is shown alone.
    try:
        return workcell(robot, read_sensor_file(SENSOR)), []
    except ScenarioError as error:
        remedy = f"A sensor that fits can be named with it: cmmsim show {' '.join(names)} SENSOR"
        return workcell(robot), [
            f"{robot.name} is shown without cameras, because {error}. {remedy}"
        ]


def kind_of(name: str) -> str:
    """Tell whether a built-in name or a file is a "robot" or a "sensor".

    Raises ScenarioError if there is no such name or file, or the file is neither.
    """
    from cmmsim.files import built_in_names
    from dynamics import built_in_robots
    from dynamics.files import is_file, parse_toml, read_text

    if name in built_in_robots():
        return "robot"
    if name in built_in_names():
        return "sensor"
    if not is_file(name):
        valid = f"robots {', '.join(built_in_robots())}, sensors {', '.join(built_in_names())}"
        raise ScenarioError(f"there is no robot, sensor or file {name!r}; built in: {valid}")
    content = parse_toml(read_text(name, name, ScenarioError), name, ScenarioError)
    shown = ("robot", "sensor")
    for kind in shown:
        if KEYS[kind] & content.keys():
            return kind
    robot, sensor = (", ".join(sorted(KEYS[kind])) for kind in shown)
    raise ScenarioError(
        f"{name} is neither a robot nor a sensor: a robot has {robot}, a sensor {sensor}; it has "
        f"{', '.join(content) or 'nothing'}"
    )
