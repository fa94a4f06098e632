"""Commands that explain an identified run, and the gauntlet, which judges the diagnosis itself."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.help import ROWS_FAILED
from identify.commands.options import (
    MOST_WORKERS,
    JsonFile,
    Plugins,
    Quiet,
    Settings,
    allow_named,
    completion,
    repeatable,
    tell,
)
from identify.commands.options import parse_settings as parsed
from identify.commands.study import workers_of
from identify.errors import StudyInterrupted
from identify.files.lock import lock_folder
from identify.files.run_folder import RunFolder
from identify.progress import print_table, terminal_progress
from identify.runtime import STOPPED, cores, interruptible_imports

if TYPE_CHECKING:
    from identify.diagnosis.diagnosis import Diagnosis
    from identify.estimation.budget import Budget

SHOWN = 12  # largest number of candidates in the table

HEADER = ("cause or group", "explains\n%", "statistic", "free\nnumbers", "chance", "size", "unit")


def diagnose(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of an identified run.")],
    add: Annotated[
        list[str] | None, repeatable("Additional cause of your own, as module:function", "none")
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Name the causes for which the identified model misses its record, with size and remedy.

    Each cause of a catalogue, such as the zero of a joint or the clock of the commands, is judged
    by the share of the misfit that it explains. The one that explains most is fitted beside the
    parameters, then the others are judged again. cmmsim identify does the same if noise does not
    explain the record, unless the drift watch of the cameras has warned. If no cause is needed, the
    command says so, and prints the causes only with --add.
    A cause of your own is a function (run, size) that returns the model of the run with this cause,
    see identify.diagnosis.diagnose.

    Reads scenario.toml, experiment.nc and result.json of the folder.

    Writes the entry diagnosis of result.json there, which is also the JSON.

    \b
    Examples:
      cmmsim diagnose runs/quick-0
      cmmsim diagnose mine --add my_module:backlash
    """
    with interruptible_imports():
        from identify.diagnosis.catalogue import own_cause
        from identify.stages.explain import diagnose as diagnose_run

    RunFolder(run).require("scenario.toml", "experiment.nc", "result.json")
    allow_named(add)
    context.with_resource(lock_folder(run))
    found = diagnose_run(run, [own_cause(name) for name in add or ()])
    tell(found.to_dict(), json, quiet, lambda: _say(found, ranked=bool(add)))


def _say(found: "Diagnosis", ranked: bool) -> None:
    """Print the findings with their remedies, or that no cause is needed, and the ranking.

    If no cause is needed, the ranking is printed only if ``ranked`` is true.
    """
    if found.not_needed:
        typer.echo(found.not_needed)
        if not ranked:
            typer.echo("what each cause would explain: entry diagnosis of result.json, or --json -")
            return
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
    if found.not_needed:
        return
    typer.echo(str(found))
    for finding in found.findings:
        for remedy in finding.remedies:
            typer.echo(f"  {remedy}")


def budget(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of an identified run.")],
    json: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """State what each source of uncertainty adds to poses, parameters and predicted motion.

    The form is that of the GUM: the squares of the sources' contributions sum up to the square of
    the combined standard uncertainty. Sources are noise of the poses, cameras, teaching, clocks,
    geometry, drives, scale anchor, initial guess, and others that the run states. The parts are
    those of the covariance of the identification. Predictions need a validated run.

    Reads scenario.toml, experiment.nc, covariance.nc and result.json of the folder, and of a
    validated run also validation.nc and trajectories.json.

    Writes budget.json, which is also the JSON, budget.csv, and budget.png, which leaves out
    parameters that are not identified, into the folder budget there.

    \b
    Example:
      cmmsim budget runs/quick-0
    """
    with interruptible_imports():
        from identify.files.run_folder import load_result, save_files
        from identify.reporting.figures.estimates import budget_figure
        from identify.reporting.figures.style import drawn
        from identify.stages.explain import error_budget

    RunFolder(run).require("scenario.toml", "experiment.nc", "covariance.nc", "result.json")
    context.with_resource(lock_folder(run))
    found = error_budget(run)
    entries = load_result(RunFolder(run).result)["identification"]["parameters"]
    known = {name: bool(entry["identifiable"]) for name, entry in entries.items()}
    folder = RunFolder(run).budget
    files: dict[str, Any] = {
        "budget.png": drawn(lambda: budget_figure(found, known)),
        "budget.json": found.to_dict(),
    }
    table = found.to_dataframe()
    # Poses and predictions have no entry.
    table["identified"] = table["quantity"].map(known)
    files["budget.csv"] = table.to_csv(index=False)
    save_files(folder, files)
    identified = [name for name, shown in known.items() if shown]
    tell(found.to_dict(), json, quiet, lambda: _print_budget(found, identified, folder))


# First of three entries of a pose, whose mean variance makes a column of the table.
GROUPS = ("pose.x", "pose.alpha", "prediction.x", "prediction.alpha")


NEGLIGIBLE = 1e-3  # fraction of a column's whole below which the table only gives an upper bound


def _print_budget(found: "Budget", identified: list[str], folder: Path) -> None:
    """Print what each source adds to poses and identified parameters.

    The order is that of the predicted positions, or without them of the shares.
    """
    import numpy as np

    columns = []
    for first in GROUPS:
        if first in found.quantities:
            index = found.quantities.index(first)
            columns.append(1e6 * np.sqrt(np.maximum(found.variances[index : index + 3].mean(0), 0)))
    shares = 100 * found.shares[[found.quantities.index(name) for name in identified]]
    means = shares.mean(axis=0) if identified else np.zeros(len(found.sources))
    main, ranked = (columns[-2], "predicted um") if len(columns) == 4 else (means, "share")
    order = np.argsort(-main, kind="stable")
    rows = []
    for source in order:
        most = identified[int(np.argmax(shares[:, source]))] if means[source] else ""
        numbers = [_short(column[source], float(np.linalg.norm(column))) for column in columns]
        rows.append((found.words[source], *numbers, _short(means[source], means.sum()), most))
    combined = [f"{np.sqrt(np.sum(column**2)):.3g}" for column in columns]
    rows.append(("combined", *combined, f"{means.sum():.3g}", ""))
    titles = ("pose\num", "pose\nurad", "predicted\num", "predicted\nurad")[: len(columns)]
    header = ("source", *titles, "share\n%", "most in")
    print_table(
        header,
        rows,
        ("source", "most in"),
        f"what each source adds to the standard uncertainty, the largest {ranked} first",
        "the squares sum up to that of the combined one; poses: root mean square of three axes; "
        "share: mean share of the variances of identified parameters",
    )
    largest: dict[str, list[str]] = {}
    for title, column in zip((*titles, "share"), (*columns, means), strict=True):
        source = found.words[int(np.argmax(column))]
        largest.setdefault(source, []).append(" ".join(title.split()))
    said = "; ".join(f"of {', '.join(named)}: {source}" for source, named in largest.items())
    typer.echo(f"largest source {said}")
    typer.echo(f"table and picture: {folder}")


def _short(part: float, whole: float) -> str:
    """Format a number, or only an upper bound of it if it is a negligible part of a whole."""
    least = NEGLIGIBLE * whole
    return f"<{least:.1g}" if 0 < abs(part) < least else f"{part:.3g}"


GAUNTLET_HEADER = ("what", "right", "of", "share\n%", "95 % interval\n%", "goal")


def gauntlet(
    cases: Annotated[int, typer.Option(min=1, help="Number of cases.")] = 200,
    scenario: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Scenario of the laboratory, to which the errors are added.",
            autocompletion=completion("scenario"),
        ),
    ] = "quick",
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the cases.", show_default="runs/gauntlet-SEED"),
    ] = None,
    wrong: Annotated[
        str,
        typer.Option(
            help="What is wrong in each case: none, one, two, outside (of the catalogue), or drawn "
            "from these."
        ),
    ] = "drawn",
    settings: Settings = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_WORKERS,
            help="Number of worker processes; 0 runs all cases in this process.",
            show_default="one per core",
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Judge the diagnosis: draw what is wrong, run, identify, diagnose, remedy, identify again.

    In each case of a simulated laboratory, nothing is wrong, or one thing, or two things, or
    something for which the diagnosis has no cause. The estimator knows none of this. The verdict on
    a case is right intervals, right cause or failed. The errors are those of a workshop, but large
    enough that the misfit doubles in nearly all cases.

    The cases are rows of a study. Finished cases are stored in the folder. After Ctrl-C, the same
    command continues. A larger number of cases adds to those that are there.

    Reads the scenario, and the robot and sensor that it names.

    Writes into the folder gauntlet.csv, with a row for each case; gauntlet.json, the fractions of
    right verdicts with their 95 % intervals and all misses, which is also the JSON; gauntlet.md and
    gauntlet.html, the same as tables; and the files of a study.

    \b
    Examples:
      cmmsim gauntlet --cases 20 --workers 2 --out runs/gauntlet
      cmmsim gauntlet --wrong none --cases 40 --seed 1
    """
    with interruptible_imports():
        from identify.studies.gauntlet_table import write
        from identify.studies.processes import check_memory
        from identify.studies.runner import run_study
        from identify.studies.study_design import prepare
        from identify.studies.study_file import Study

    empty = Study(name="gauntlet", kind="gauntlet", scenario=scenario)
    given: dict[str, Any] = {"seed": seed, "repeats": cases, "options.wrong": wrong}
    changes = {f"scenario.{key}": value for key, value in parsed(settings).items()}
    chosen = empty.with_settings(given | changes)
    shared = prepare(chosen)
    count = cores() if workers is None else workers
    check_memory(chosen, shared, max(count, 1))
    folder = out or Path("runs") / f"gauntlet-{seed}"
    try:
        progress = terminal_progress(quiet, rate="cases/s")
        outcome = run_study(
            chosen, folder, progress, workers_of(None, count, insecure=False), shared=shared
        )
    except StudyInterrupted as stopped:
        typer.echo(f"{stopped}; the same command goes on from there", err=True)
        raise typer.Exit(STOPPED) from None
    entry = write(folder, chosen, outcome.frame)
    tell(entry, json, quiet, lambda: _say_judged(entry, folder))
    if outcome.failures:
        typer.echo(
            f"{len(outcome.failures)} of {outcome.rows} cases could not be computed; "
            f"{outcome.failures[0]}",
            err=True,
        )
        raise typer.Exit(ROWS_FAILED)


def _say_judged(entry: dict[str, Any], folder: Path) -> None:
    """Print the fractions of right verdicts, and the numbers of verdicts."""
    rows = [
        (
            one["what"],
            str(one["right"]),
            str(one["cases"]),
            f"{100 * one['share']:.3g}",
            f"{100 * one['low']:.3g} to {100 * one['high']:.3g}",
            one["goal"],
        )
        for one in entry["shares"]
    ]
    print_table(GAUNTLET_HEADER, rows, ("what", "goal"), f"gauntlet of {entry['cases']} cases")
    covered = entry["intervals_after_remedy"]
    if covered:
        typer.echo(
            f"{covered['covered_percent']:.3g} % of the 95 % intervals hold after the remedy, in "
            f"{covered['cases']} cases whose cause was named"
        )
    typer.echo(
        f"{', '.join(f'{n} {verdict}' for verdict, n in entry['verdicts'].items())}; tables: "
        f"{folder / 'gauntlet.md'}"
    )
