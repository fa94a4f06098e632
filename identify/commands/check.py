"""Command ``check``: checks a robot, or the telemetry of a run, before anything is identified."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.kinds_of_files import check_kind
from identify.commands.options import (
    STANDARD_OUTPUT,
    JsonFile,
    Plugins,
    Quiet,
    Settings,
    chosen_scenario,
    completion,
    tell,
)
from identify.errors import VerificationError
from identify.progress import print_table, terminal_progress

if TYPE_CHECKING:
    from identify.verification.finding import Finding

# Options for robots. A record states its own scenario.
OF_ROBOTS = ("--scenario", "--parameters", "--set")


def check(
    robot: Annotated[
        str,
        typer.Argument(
            help="Built-in robot, or the path of a robot file; or a record of your own: a netCDF "
            "file, a log with its TOML file, or a TOML file that names its log.",
            metavar="ROBOT|RECORD",
            autocompletion=completion("robot"),
        ),
    ],
    scenario: Annotated[
        str | None,
        typer.Option(
            help="Scenario that gives the servo, timing and limits.",
            show_default="paper",
            autocompletion=completion("scenario"),
        ),
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="SET",
            help="Parameter set of the robot.",
            show_default="the scenario's truth, else guess",
        ),
    ] = None,
    settings: Settings = None,
    page: Annotated[
        Path | None,
        typer.Option(
            "--page", metavar="FILE", help="Page about a record.", show_default="RECORD-check.html"
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Check the design of a robot, or the telemetry of a record, on one page.

    Robot: the checks of the mechanism are reach, travel and singularities at home and over the
    travel, assembly modes, holding torques, identifiable parameters, and physically possible
    inertias. The checks of the loop are its stability, the largest stable gains and lowest stable
    frame rate, the bandwidth and damping of its gains, and the gains for the bandwidth and damping
    that the scenario's [control] requests. The platform in the scenario's sensor file must be the
    robot's platform. Each finding has its value, its limit, and the leg that it concerns.

    Record: the checks are rates and jitter of the times, gaps and whether commands changed in them,
    noise of the poses beside the stated noise, jumps and frozen poses, travel and spectrum of the
    motion, commands at the end of their range, units, axes, directions and zeros that are likely
    wrong, the clocks of poses and commands, and the groups of parameters that the motion can show.

    Reads a robot file and a scenario, or a record and the TOML file that describes it. Writes the
    JSON: whether all checks pass, and the findings. For a record it also writes an HTML page with
    the findings and pictures.

    \b
    Examples:
      cmmsim check mine.toml
      cmmsim check ups6 --scenario quick --json findings.json
      cmmsim check ups6 --set control.servo_bandwidth_rad_s=4.0
      cmmsim check mine.csv
    """
    from identify.record.own_record import is_record

    path = Path(robot)
    if is_record(path):
        given = (scenario, parameters, settings)
        for option, value in zip(OF_ROBOTS, given, strict=True):
            if value:
                raise typer.BadParameter(
                    f"{robot} is a record, which states its own scenario", param_hint=option
                )
        _check_record(path, page or Path(f"{path.stem}-check.html"), json, quiet)
        return
    check_kind("robot", robot)
    if page is not None:
        raise typer.BadParameter(f"{robot} is a robot, and has no page", param_hint="--page")
    from dynamics import load_robot
    from identify.setup import Setup
    from identify.verification.robot_check import checked_in

    chosen = load_robot(robot)
    setup = Setup(chosen_scenario(scenario or "paper", settings, None))
    name, findings = checked_in(setup, chosen, parameters, terminal_progress(quiet))
    _tell(findings, f"{chosen.name}, parameters `{name}`", chosen.name, json, quiet)


def _check_record(path: Path, page: Path, json: Path | None, quiet: bool) -> None:
    from identify.files.atomic import check_writable, write_text
    from identify.verification.logged_run import read_logged_run
    from identify.verification.telemetry_check import check_telemetry
    from identify.verification.telemetry_page import telemetry_page

    check_writable(page)
    logged = read_logged_run(path)
    findings = check_telemetry(logged, terminal_progress(quiet))
    write_text(page, telemetry_page(logged, findings, path.name))
    _tell(findings, f"{path.name}, page: {page}", path.name, json, quiet)


def _tell(
    findings: "list[Finding]", title: str, about: str, json: Path | None, quiet: bool
) -> None:
    """Output findings about a robot or record, and raise VerificationError if any of them fails."""
    failed = [finding for finding in findings if not finding.ok]
    rows = [
        (
            "NO" if not finding.ok else "-" if finding.value is None else "yes",
            finding.check,
            "" if finding.limit is None else f"{finding.relation} {finding.limit:.3g}",
            finding.whole,
        )
        for finding in findings
    ]
    header = ("ok", "check", "limit", "finding")
    entry: dict[str, Any] = {
        "ok": not failed,
        "findings": [finding.entry() for finding in findings],
    }
    tell(entry, json, quiet, lambda: print_table(header, rows, header, title))
    if failed:
        # standard output has the texts, unless it has neither the table nor the JSON
        shown = not quiet or str(json) == STANDARD_OUTPUT
        said = (
            ", ".join(finding.check for finding in failed)
            if shown
            else "; ".join(f"{finding.check}: {finding.text}" for finding in failed)
        )
        raise VerificationError(
            f"{len(failed)} of {len(findings)} findings about {about} fail: {said}"
        )
