"""The command ``cmmsim study``. Heavy imports are late."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.errors import StudyError, StudyInterrupted
from identify.progress import print_table, terminal_progress
from identify.runtime import STOPPED

if TYPE_CHECKING:
    from identify.studies.runner import Outcome, Workers
    from identify.studies.study_file import Study

MANY_ROWS = 100_000
"""Rows of a study above which it must be confirmed."""

SOME_ROWS_FAILED = 3
"""Exit status of a study that is done, but in which rows failed."""

A_LAW_FAILED = 4
"""Exit status of a study whose rows are all done and contradict a law that it states."""

STUDY_HELP = f"""
Run a study: a scenario varied over factors, row by row, on all cores or on many machines.

STUDY is a built-in name (--list) or a TOML file. What is finished stays in the folder: after Ctrl-C, or whatever ends
the program, the same command goes on where it stopped. The same study gives the same figures however it is run.

Bands too wide? The same command with more repeats, by --repeats or in the file, adds to what is there. With fewer, the
others are left out of the table and the summary, but none is lost. Title and laws may change too; any other change
makes another study, which needs another folder.

\b
A study file:
  name = "noise_and_baseline"
  kind = "static_pose"                            # what a row is (--kinds); or module:function of your own
  scenario = "paper"
  repeats = 10
  [changes]                                       # in every row
  scenario.renderer = "analytic"
  [factors]                                       # a grid
  sensor.camera.dark_noise = [13.0, 26.0, 52.0]   # a key of the sensor file
  sensor.rig.baseline = [0.5, 1.0, 2.0]
  options.captures = [1, 16]                      # an option of the kind
  [[theory]]                                      # a law that the summary checks; or equals = , or order =
  figure = "mean_position_rms_um"
  factor = "options.captures"
  exponent = -0.5
With sample = N at the top: N points drawn at random instead, where a factor may also be
  sensor.rig.baseline = {{ low = 0.5, high = 2.0, scale = "log" }}

\b
A row of your own, in a module on PYTHONPATH:
  def run(scenario, seed, options):               # without options: run(scenario, seed)
      rng = numpy.random.default_rng(seed)        # seed: numpy.random.SeedSequence
      return {{"error_um": ...}}                    # numbers, units in their names

\b
Written into the folder:
  study.json       the resolved study, with its scenario and sensor
  rows.jsonl       finished rows as they come
  study.parquet    one table: factors, figures with units, seeds, seconds, errors
  study.nc         the figures by factors and repeat, for xarray.open_dataset
  summary.md, summary.json, figures/*.png

\b
On many machines, all with the same cmmsim and with the files that the scenario names:
  dask scheduler                                  on one
  dask worker tcp://HOST:8786 --nthreads 1        on each, once a core
  cmmsim study STUDY --scheduler tcp://HOST:8786

\b
Exit status:
  0    all rows are done, and none contradicts a law; laws may be undecided where rows are few
  {SOME_ROWS_FAILED}    rows failed: they say why in the column error
  {A_LAW_FAILED}    all rows are done, and a law failed: its 99 % interval excludes what it states
  {STOPPED}  after Ctrl-C
  1, 2 it cannot be run: one line says why
"""


def study(
    name: Annotated[
        str | None, typer.Argument(metavar="STUDY", help="Built-in study or path of a TOML file.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the study.", show_default="runs/study-NAME")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Use a running Dask cluster: tcp://HOST:8786.")
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, help="Rows at each point.", show_default="what the study says")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Processes on this machine; 0: none but this one.", show_default="one a core"),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help=f"Do run more than {MANY_ROWS} rows.")] = False,
    list_: Annotated[bool, typer.Option("--list", help="Only list the built-in studies.")] = False,
    kinds: Annotated[
        bool, typer.Option("--kinds", help="Only list the kinds of row, with their options and figures.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar and no summary.")] = False,
) -> None:
    """Run or continue a study."""
    if list_:
        _list()
        return
    if kinds:
        _list_kinds()
        return
    if name is None:
        raise typer.BadParameter("name a built-in study or a TOML file, or ask for --list", param_hint="STUDY")
    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--workers is for this machine, not for a running cluster", param_hint="--workers")
    from identify.studies.runner import run_study
    from identify.studies.study_file import load_study

    chosen = load_study(name)
    if repeats is not None:
        chosen = chosen.model_copy(update={"repeats": repeats})
    if chosen.rows > MANY_ROWS and not yes:
        raise StudyError(f"study {chosen.name!r} has {chosen.rows:,} rows; to run more than {MANY_ROWS:,}, say --yes")
    folder = out or Path("runs") / f"study-{chosen.name}"
    try:
        outcome = run_study(chosen, folder, terminal_progress(quiet, rate="rows/s"), _workers(scheduler, workers))
    except StudyInterrupted as stopped:
        typer.echo(f"{stopped}; the same command goes on from there", err=True)
        raise typer.Exit(STOPPED) from None
    _say(folder, outcome, _summary(chosen, folder, outcome), quiet)


def _workers(scheduler: str | None, workers: int | None) -> "Workers":
    if workers == 0:
        from identify.studies.runner import in_this_process

        return in_this_process
    from identify.runtime import cores
    from identify.studies.dask_cluster import local_cluster, running_cluster

    return partial(running_cluster, scheduler) if scheduler else partial(local_cluster, workers or cores())


def _summary(study: "Study", folder: Path, outcome: "Outcome") -> list[dict[str, Any]]:
    """Write the summary; the laws with their verdicts."""
    from identify.studies import summary
    from identify.studies.table import written

    with written(folder / summary.MARKDOWN, "; all rows are kept, and the same command writes it again"):
        return list(summary.write(folder, study, outcome.frame)["theory"])


def _say(folder: Path, outcome: "Outcome", laws: list[dict[str, Any]], quiet: bool) -> None:
    """What came out; an exit status of its own, and a line on standard error, where rows or laws failed."""
    if not quiet:
        for law in laws:
            typer.echo(_law_line(law))
        again = f", {outcome.found} of them from before" if outcome.found else ""
        again += f" ({outcome.beyond} more, of further repeats, are kept)" if outcome.beyond else ""
        typer.echo(f"{outcome.rows} rows{again}; summary.md, figures and study.parquet: {folder}")
    broken = [law for law in laws if law["verdict"] == "failed"]
    if broken:
        typer.echo(f"{len(broken)} of {len(laws)} laws failed; {_law_line(broken[0])}", err=True)
    if outcome.failures:
        typer.echo(f"{len(outcome.failures)} of {outcome.rows} rows failed; {outcome.failures[0]}", err=True)
        raise typer.Exit(SOME_ROWS_FAILED)
    if broken:
        raise typer.Exit(A_LAW_FAILED)


def _law_line(law: dict[str, Any]) -> str:
    measured = law["reason"]
    if law["measured"] is not None:
        measured = f"{law['measured']:.4g} ({law['low']:.4g} to {law['high']:.4g}), expected {law['expected']}"
    return f"{law['verdict']}: {law['statement']}: {measured}"


def _list() -> None:
    from identify.studies.study_file import STUDIES, load_study

    studies = [(name, load_study(name)) for name in STUDIES.names()]
    rows = [(name, f"{found.rows:,}", found.title) for name, found in studies]
    print_table(("study", "rows", "what it asks"), rows, ("study", "what it asks"))


def _list_kinds() -> None:
    from identify.studies.design import valid_keys
    from identify.studies.rows import KINDS
    from identify.studies.table import factor_unit

    for kind in KINDS.values():
        typer.echo(f"{kind.name}: {kind.what}\n\nIt reads {kind.reads}, and its options; no other factor is taken.\n")
        options = [
            (path, str(field.default), factor_unit(path), str(field.description))
            for path, field in valid_keys(kind.options).items()
            if path.startswith("options.")
        ]
        print_table(("option", "default", "unit", "what it is"), options, ("option", "default", "unit", "what it is"))
        figures = [
            (name, "" if column.unit == "1" else column.unit, column.meaning) for name, column in kind.columns.items()
        ]
        print_table(("figure", "unit", "what it is"), figures, ("figure", "unit", "what it is"))
        typer.echo()
