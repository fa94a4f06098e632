"""Command that names the causes for which an identified model misses its record."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from identify.commands.options import JsonFile, Plugins, Quiet, allow_named, repeatable, tell
from identify.files.lock import lock_folder
from identify.files.run_folder import RunFolder
from identify.progress import print_table
from identify.runtime import interruptible_imports

if TYPE_CHECKING:
    from identify.diagnosis.diagnosis import Diagnosis

SHOWN = 12
"""Number of candidates that the table has."""

HEADER = ("cause or group", "explains\n%", "statistic", "free\nnumbers", "chance", "size", "unit")


def diagnose(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of an identified run.")],
    add: Annotated[
        list[str] | None, repeatable("Cause of one's own beside these, as module:function", "none")
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Name the causes for which the identified model misses its record, with size and remedy.

    Each cause of a catalogue, as the zero of a joint or the clock of the commands, is judged by how
    much it explains of what the model leaves of the record. The first one is fitted beside the
    parameters, then the next one is asked. cmmsim identify does the same where noise does not
    explain the record. A cause of one's own is a function (run, size) that returns the model of the
    run with it, see identify.diagnosis.own_cause.

    Reads scenario.toml, experiment.nc and result.json of the folder.

    Writes the entry diagnosis of result.json there, which is also the JSON.

    \b
    Examples:
      cmmsim diagnose runs/quick-0
      cmmsim diagnose mine --add my_module:backlash
    """
    with interruptible_imports():
        from identify.diagnosis.own_cause import own_cause
        from identify.stages.diagnose import diagnose as diagnose_run

    RunFolder(run).require("scenario.toml", "experiment.nc", "result.json")
    allow_named(add)
    context.with_resource(lock_folder(run))
    found = diagnose_run(run, [own_cause(name) for name in add or ()])
    tell(found.to_dict(), json, quiet, lambda: _say(found))


def _say(found: "Diagnosis") -> None:
    """Print the ranking, and the findings with their remedies."""
    rows = [
        (
            one.name,
            f"{100 * one.share:.1f}",
            f"{one.statistic:.1f}",
            str(one.freedoms),
            f"{one.chance:.2g}",
            "-" if one.value is None else f"{one.value:.3g} ± {one.std:.2g}",
            one.unit,
        )
        for one in found.candidates[:SHOWN]
    ]
    print_table(
        HEADER,
        rows,
        ("cause or group", "size", "unit"),
        f"causes, of {len(found.candidates)}: what each alone explains of the misfit",
        "chance: probability that a right model has such a statistic for any of them; size: to "
        "first order, ± its standard deviation by noise",
    )
    typer.echo(str(found))
    for finding in found.findings:
        for remedy in finding.remedies:
            typer.echo(f"  {remedy}")
