"""Command ``import``: robots from files of other programs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynamics.errors import RobotFileError
from identify.commands.help import Command, Commands
from identify.commands.options import Quiet
from identify.errors import OutputFolderError
from identify.files.atomic import write_files

if TYPE_CHECKING:
    from dynamics.robot_file import RobotDescription

IMPORT_HELP = """
Read a robot from a file of another program. Its legs must be of the known kinds.

Writes a robot file with the geometry of that file, and with its inertias and friction as the
parameter set `guess`. Each joint is checked. A mechanism that is not such a robot is refused with
the reason in one line.
"""

imports = typer.Typer(
    name="import", cls=Commands, help=IMPORT_HELP, no_args_is_help=True, rich_markup_mode=None
)

Out = Annotated[
    Path,
    typer.Option(metavar="ROBOT.toml", help="Robot file to write. An existing file is replaced."),
]


@imports.command(cls=Command)
def mjcf(
    file: Annotated[
        Path, typer.Argument(help="MJCF file whose loops are connect or weld equalities.")
    ],
    out: Out,
    quiet: Quiet = False,
) -> None:
    """Read a robot from MJCF, with the defaults, includes and geom masses that MuJoCo applies.

    Reads an MJCF file. Writes a robot file.

    \b
    Examples:
      cmmsim import mjcf model.xml --out mine.toml
      cmmsim check mine.toml
    """
    from dynamics.engines.mjcf_import import robot_of_mjcf

    _write(*_read(robot_of_mjcf, file), f"From {file.name}, imported by cmmsim.", out, quiet)


@imports.command(cls=Command)
def urdf(
    file: Annotated[Path, typer.Argument(help="URDF file, a tree of bodies.")],
    out: Out,
    closures: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="YAML file with closed_loop, type and name_mot, as in example-parallel-robots.",
            show_default="the name of FILE, with .yaml",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Read a robot from URDF and a YAML file of its loop closures and motors.

    Reads both files. Writes a robot file.

    \b
    Examples:
      cmmsim import urdf ups6.urdf --out mine.toml
                                with ups6.yaml, as cmmsim export writes it
      cmmsim import urdf robot.urdf --closures loops.yaml --out mine.toml
    """
    from dynamics.engines.urdf_import import robot_of_urdf

    loops = closures or file.with_suffix(".yaml")
    if closures is None and file.is_file() and not loops.is_file():
        raise RobotFileError(
            f"{file}: there is no {loops} with the closures of its loops; name it by --closures"
        )
    _write(
        *_read(robot_of_urdf, file, loops),
        f"From {file.name} with {loops.name}, imported by cmmsim.",
        out,
        quiet,
    )


def _read(read: Callable[..., Any], *files: Path) -> tuple["RobotDescription", list[str]]:
    """Read a robot, and notes on it, from untrusted files, within limits of time and memory."""
    from identify.files.limited_process import UntrustedFileError, within_limits

    try:
        found: tuple[RobotDescription, list[str]] = within_limits(read, *files)
    except UntrustedFileError as error:
        raise RobotFileError(f"{files[0]}: {error}") from None
    return found


def _write(
    description: "RobotDescription", notes: list[str], source: str, out: Path, quiet: bool
) -> None:
    from dynamics.robot_file import read_robot_file
    from dynamics.robot_text import robot_text

    if out.suffix != ".toml":
        raise OutputFolderError(f"cannot write {out}: the name of a robot file ends in .toml")
    description, said = _with_usable_meshes(description)
    notes = [*notes, *said]
    text = robot_text(description, [source, *notes])
    write_files({out: text.encode()}, parents=True, check=read_robot_file)
    if quiet:
        return
    kinds = ", ".join(str(getattr(leg, "type", "")) for leg in description.geometry.legs)
    typer.echo(
        f"{description.name}: platform moves in "
        f"{', '.join(description.geometry.chart.coordinate_names)}"
    )
    for line in [f"legs: {kinds}", *notes, f"robot: {out}; judge it with: cmmsim check {out}"]:
        typer.echo(line)


def _with_usable_meshes(description: "RobotDescription") -> "tuple[RobotDescription, list[str]]":
    """Leave out meshes that cannot be drawn, with a remark on each."""
    from cmmsim import CmmError
    from identify.experiment.leg_bodies import stated_mesh

    meshes = []
    said = []
    for mesh in description.geometry.meshes:
        try:
            stated_mesh(mesh, mesh.body)
        except (CmmError, RobotFileError) as error:
            said.append(f"{mesh.body} is drawn as a rod: {error}")
        else:
            meshes.append(mesh)
    geometry = replace(description.geometry, meshes=tuple(meshes))
    return replace(description, geometry=geometry), said
