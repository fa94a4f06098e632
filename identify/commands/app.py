"""Command ``cmmsim``: its commands by group, its first help, and its handling of errors."""

import errno
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from typing import Annotated

import typer

from identify.commands.camera_calibration import calibrate
from identify.commands.check import check
from identify.commands.comparisons import estimators, variation
from identify.commands.diagnosis import budget, diagnose, gauntlet
from identify.commands.geometry_run import geometry
from identify.commands.help import (
    BEYOND_LIMIT,
    NOT_DONE,
    Command,
    Commands,
    Judging,
    RowsCommand,
    StudyCommand,
)
from identify.commands.importing import imports
from identify.commands.new import new
from identify.commands.paper import paper
from identify.commands.photographs import measure, teach
from identify.commands.robot_pages import base_parameters, export, verify_model, workspace
from identify.commands.run_stages import excite, identify, record, report, run, validate, warm_up
from identify.commands.scene import replay, show
from identify.commands.sensor_tests import acceptance, detectors
from identify.commands.study import study
from identify.commands.tracking_runs import track
from identify.errors import IdentifyError, VerificationError, WriteError
from identify.runtime import stoppable

HELP = """
Identify a parallel robot from rendered stereo images, and prove how good the result is.

A simulated stereo camera measures the pose of a simulated robot, a visual servo moves it along an
exciting trajectory, and its dynamic parameters are estimated from the record. The identified model
is then validated on trajectories that were not used for the estimate.
"""

EXAMPLES = """
Examples:
  cmmsim run quick                     a whole experiment, a short one
  cmmsim run quick --robot ups6        with another robot, or your own file
  cmmsim new robot mine.toml           a commented file to start from
  cmmsim check mine.toml               check the design of a robot
  cmmsim study --list                  studies, such as error against noise
  cmmsim COMMAND --help                files and exit status of a command
"""

# Error numbers of a full disk, an exhausted quota, and a file above the size limit.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

app = typer.Typer(
    name="cmmsim",
    cls=Commands,
    help=HELP,
    epilog=EXAMPLES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run the command.

    A known error is printed as one line on standard error. The exit statuses are those of
    `identify.commands.help`.
    """
    warnings.showwarning = _show_warning
    try:
        with _printing():
            app()
    except Exception as error:
        # An unknown error is a defect of the program, and its traceback is needed.
        if not is_known(error):
            raise
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise SystemExit(
            BEYOND_LIMIT if isinstance(error, VerificationError) else NOT_DONE
        ) from None


@contextmanager
def _printing() -> Iterator[None]:
    """Raise WriteError if standard output is a file on a full disk."""
    try:
        yield
    except OSError as error:
        # Errors of reading have a file name, and those of writing a file are WriteError.
        if error.filename is not None or error.errno not in NO_ROOM:
            raise
        # Without closing the stream, Python would write the rest at exit, and fail again.
        with suppress(OSError):
            sys.stdout.close()
        raise WriteError(f"cannot write standard output: {error.strerror}") from None


def _show_warning(
    message: Warning | str, category: type[Warning], *place: object, **more: object
) -> None:
    """Print a warning as one line, without the line of code that caused it."""
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


def is_known(error: Exception) -> bool:
    """Tell whether an error is one that the three packages raise on purpose, or names a file."""
    if isinstance(error, IdentifyError) or (
        isinstance(error, OSError) and error.filename is not None
    ):
        return True
    from cmmsim.errors import CmmError, OpenGLMissingError
    from dynamics.errors import DynamicsError

    return isinstance(error, (CmmError, OpenGLMissingError, DynamicsError))


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cmmsim {metadata.version('cmmsim')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    pass


def _add(group: str, *commands: Callable[..., None], cls: type[Command] = Command) -> None:
    """Register commands, in this order, in a group of the help."""
    for command in commands:
        app.command(rich_help_panel=group, cls=cls)(command)


EXPERIMENT = "An experiment as a whole"
STAGES = "Its stages, each reading what the one before wrote"
RECORDS = "More from a run"
ROBOTS = "Robots"
SENSORS = "Sensors"
STUDIES = "Studies"
PICTURES = "What it looks like"
SETTING_UP = "Setting up"

_add(EXPERIMENT, run, cls=Judging)
_add(EXPERIMENT, paper)
_add(STAGES, excite, record, identify, validate)
_add(STAGES, report, cls=Judging)
_add(RECORDS, diagnose, budget, estimators, variation, track)
_add(PICTURES, replay, show)
_add(ROBOTS, check, cls=Judging)
_add(ROBOTS, workspace, base_parameters, geometry)
_add(ROBOTS, verify_model, cls=Judging)
app.add_typer(export, name="export", rich_help_panel=ROBOTS)
app.add_typer(imports, name="import", rich_help_panel=ROBOTS)
_add(SENSORS, acceptance, cls=Judging)
_add(SENSORS, detectors, calibrate, teach, measure)
_add(STUDIES, stoppable(study), cls=StudyCommand)
_add(STUDIES, stoppable(gauntlet), cls=RowsCommand)
app.add_typer(new, name="new", rich_help_panel=SETTING_UP)
_add(SETTING_UP, warm_up)
