"""Command ``check``: checks a robot file before anything is built or run."""

from textwrap import shorten
from typing import Annotated

import typer

from identify.commands.options import (
    JsonFile,
    Plugins,
    Quiet,
    RobotArgument,
    Settings,
    chosen_scenario,
    completion,
    tell,
)
from identify.errors import VerificationError
from identify.progress import print_table, terminal_progress

LONGEST = 160
"""Largest number of characters of a finding in the error message.

The table and the JSON hold the whole text.
"""


def check(
    robot: RobotArgument,
    scenario: Annotated[
        str,
        typer.Option(
            help="Scenario that gives the servo, timing and limits.",
            autocompletion=completion("scenario"),
        ),
    ] = "paper",
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="SET",
            help="Parameter set of the robot.",
            show_default="the scenario's truth, else initial",
        ),
    ] = None,
    settings: Settings = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Check the design of a robot, on one page.

    The checks of the mechanism are reach, travel and singularities at home and over the travel,
    assembly modes, holding torques, identifiable parameters, and physically possible inertias. The
    checks of the loop are its stability, the largest stable gains and lowest stable frame rate, the
    bandwidth and damping of its gains, and the gains for the bandwidth and damping that the
    scenario's [control] requests. The platform in the scenario's sensor file must be the robot's
    platform. Each finding has its value, its limit, and the leg that it concerns.

    Reads a robot file and a scenario. Writes only the JSON: whether all checks pass, and the
    findings.

    \b
    Examples:
      cmmsim check mine.toml
      cmmsim check ups6 --scenario quick --json findings.json
      cmmsim check ups6 --set control.servo_bandwidth_rad_s=4.0
    """
    from dynamics import load_robot
    from identify.experiment.law_in_loop import feedback
    from identify.loop_parameters import NOMINAL, check_parameter_set, loop_settings
    from identify.verification.robot_check import CheckSettings, check_robot

    chosen = load_robot(robot)
    given = chosen_scenario(scenario, settings, None)
    name = parameters or (
        given.plant.parameters if given.plant.parameters in chosen.parameter_sets else NOMINAL
    )
    check_parameter_set(chosen, name)
    values = chosen.parameter_sets[name].vector
    around = CheckSettings(
        settings=loop_settings(chosen, given.servo, given.timing, given.control, given.model),
        control=given.control,
        feedback=feedback(given.control, given.timing),
        limits=given.excitation,
        sensor=given.sensor,
        sensor_file=given.sensor_file(),
    )
    findings = check_robot(chosen, values, around, terminal_progress(quiet))
    failed = [finding for finding in findings if not finding.ok]
    rows = [
        (
            "yes" if finding.ok else "NO",
            finding.check,
            "" if finding.limit is None else f"{finding.limit:.3g}",
            finding.text,
        )
        for finding in findings
    ]
    header = ("ok", "check", "limit", "finding")
    title = f"{chosen.name}, parameters `{name}`"
    entry = {"ok": not failed, "findings": [finding.entry() for finding in findings]}
    tell(entry, json, quiet, lambda: print_table(header, rows, header, title))
    if failed:
        lines = [f"{finding.check}: {finding.text}" for finding in failed]
        said = "; ".join(shorten(line, LONGEST, placeholder=" …") for line in lines)
        raise VerificationError(
            f"{len(failed)} of {len(findings)} findings about {chosen.name} fail: {said}"
        )
