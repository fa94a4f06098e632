"""Command that judges the diagnosis over many cases in which something is wrong."""

from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.help import ROWS_FAILED
from identify.commands.options import MOST_WORKERS, JsonFile, Quiet, Settings, completion, tell
from identify.commands.options import parse_settings as parsed
from identify.commands.study import workers_of
from identify.errors import StudyInterrupted
from identify.progress import print_table, terminal_progress
from identify.runtime import STOPPED, cores, interruptible_imports

HEADER = ("what", "right", "of", "share\n%", "95 % interval\n%", "goal")


def gauntlet(
    cases: Annotated[int, typer.Option(min=1, help="Number of cases.")] = 200,
    scenario: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Scenario of the laboratory, without trouble.",
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

    In each case of a simulated laboratory nothing is wrong, one thing, two things, or something for
    which the diagnosis has no cause. The estimator knows none of this. The verdict on a case is
    right intervals, right cause or failed. Sizes are those of a workshop, large enough that the
    misfit doubles in nearly all cases.

    The cases are rows of a study. Finished cases are stored in the folder. After Ctrl-C the same
    command continues, and a larger number of cases adds to those that are there.

    Reads the scenario, and the robot and sensor that it names.

    Writes into the folder gauntlet.csv, a row a case; gauntlet.json, the shares with their 95 %
    intervals and all misses, which is also the JSON; gauntlet.md and gauntlet.html, the same as
    tables; and the files of a study.

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
    tell(entry, json, quiet, lambda: _say(entry, folder))
    if outcome.failures:
        typer.echo(
            f"{len(outcome.failures)} of {outcome.rows} cases could not be computed; "
            f"{outcome.failures[0]}",
            err=True,
        )
        raise typer.Exit(ROWS_FAILED)


def _say(entry: dict[str, Any], folder: Path) -> None:
    """Print the shares."""
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
    print_table(HEADER, rows, ("what", "goal"), f"gauntlet of {entry['cases']} cases")
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
