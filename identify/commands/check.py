"""The command ``check``: a robot file judged before anything is built or run. Heavy imports are late."""

from pathlib import Path
from typing import Annotated

import typer

from identify.errors import OutputFolderError, VerificationError
from identify.files.run_folder import save_result
from identify.progress import print_table, terminal_progress

CHECK_HELP = """
Say in a page what a designer wants to know of a robot.

Reach, travel and singularities at home and over the travel, assembly modes, holding torques, what its motion can show,
inertias that no body has, whether its loop is stable, up to which gains and down to which frame rate, and whether the
platform that the scenario's sensor sees is the robot's. Each with its number and limit, and with the leg that it
concerns. Ends with status 1 where something is beyond its limit.

\b
Examples:
  cmmsim check mine.toml
  cmmsim check ups6 --scenario quick --json findings.json
"""


def check(
    robot: Annotated[str, typer.Argument(help="Built-in robot or path of a TOML file.")],
    scenario: Annotated[str, typer.Option(help="Scenario whose servo, timing and limits count.")] = "paper",
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="SET", help="Parameter set of the robot.", show_default="the scenario's truth, else initial"
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write the findings there.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no table.")] = False,
) -> None:
    """Judge a robot file."""
    from dynamics import load_robot
    from identify.loop_parameters import NOMINAL, check_parameter_set
    from identify.scenario import load_scenario
    from identify.verification.robot_check import check_robot

    chosen, given = load_robot(robot), load_scenario(scenario)
    name = parameters or (given.plant.parameters if given.plant.parameters in chosen.parameter_sets else NOMINAL)
    check_parameter_set(chosen, name)
    values = chosen.parameter_sets[name].vector
    findings = check_robot(chosen, values, given, terminal_progress(quiet))
    failed = [finding for finding in findings if not finding.ok]
    if json is not None:
        try:
            save_result(json, {"ok": not failed, "findings": [finding.entry() for finding in findings]})
        except (OSError, ValueError) as error:
            raise OutputFolderError(f"cannot write {json}: {error}; name another file with --json") from None
    if not quiet:
        rows = [("yes" if finding.ok else "NO", finding.check, finding.text) for finding in findings]
        print_table(("ok", "check", "finding"), rows, ("ok", "check", "finding"), f"{chosen.name}, parameters `{name}`")
    if failed:
        said = "; ".join(f"{finding.check}: {finding.text}" for finding in failed)
        raise VerificationError(f"{len(failed)} of {len(findings)} findings about {chosen.name} fail: {said}")
