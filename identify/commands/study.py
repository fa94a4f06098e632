"""Command ``cmmsim study``."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.help import BEYOND_LIMIT, ROWS_FAILED
from identify.commands.options import (
    MOST_WORKERS,
    JsonFile,
    Plugins,
    completion,
    of_kind,
    parse_settings,
    tell,
)
from identify.errors import StudyError, StudyInterrupted
from identify.progress import Progress, print_table, terminal_progress
from identify.runtime import STOPPED, cores, interruptible_imports

if TYPE_CHECKING:
    import pandas as pd

    from identify.studies.runner import Outcome, Workers
    from identify.studies.study_file import Study

MANY_ROWS = 100_000  # number of rows above which a study must be confirmed


def study(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="STUDY",
            help="Built-in study (--list), or the path of a TOML file.",
            show_default=False,
            autocompletion=completion("study"),
            callback=of_kind("study"),
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the study.", show_default="runs/study-NAME"),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Use a running Dask cluster: tls://HOST:8786."),
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure",
            help="Accept a scheduler without certificates. Everyone who reaches it can then run "
            "code under your account.",
        ),
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Replace an entry of the study (repeats=5), a value of the scenario in all rows "
            "(scenario.timing.latency_s=0.01), or the list of a factor "
            "('sensor.rig.baseline=[0.5,1.0]'); repeatable.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of all randomness.", show_default="the study's seed"),
    ] = None,
    repeats: Annotated[
        int | None,
        typer.Option(min=1, help="Rows at each point.", show_default="the study's repeats"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_WORKERS,
            help="Number of worker processes on this machine; 0 runs all rows in this process.",
            show_default="one per core",
        ),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of a finished study with the same factors, to be plotted beside this "
            "study; repeatable."
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help=f"Confirm that more than {MANY_ROWS} rows shall run.")
    ] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Only print the file of the study, as a template.")
    ] = False,
    list_: Annotated[bool, typer.Option("--list", help="Only list the built-in studies.")] = False,
    kinds: Annotated[
        bool,
        typer.Option("--kinds", help="Only list the kinds of row, with their options and figures."),
    ] = False,
    json: JsonFile = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Print no progress bar and no summary.")
    ] = False,
    plugin: Plugins = None,
) -> None:
    """Run a study: a scenario varied over factors, row by row, on all cores or on many machines.

    Finished rows are stored in the folder. After Ctrl-C or a crash, the same command continues
    where the study stopped. Results do not depend on the number of workers or machines. If the
    number of repeats is raised, by --repeats or in the file, the new rows are added. If it is
    lowered, the further rows are left out of the table and the summary, but stay stored. Title,
    plots and laws can change too. Any other change makes another study, which needs another
    folder.

    Reads a study file, and the scenario, robot and sensor that it names. cmmsim new study mine.toml
    writes a commented one to start from; --show prints a built-in one.

    Writes into the folder study.json, the resolved study; rows.jsonl, the rows in the order in
    which they finish; study.parquet, a table of factors, figures with units, seeds, seconds and
    errors; study.nc, the figures as arrays over factors and repeat; summary.md and summary.json,
    which is also the JSON; and plots as PNG, PDF and SVG. The summaries are renewed while the study
    runs, and after Ctrl-C. With --beside there are also figures/side_by_side_FACTOR, plots of the
    studies side by side.

    \b
    Examples:
      cmmsim study --list
      cmmsim study pixel_noise
      cmmsim study --show pixel_noise > mine.toml
      cmmsim study pixel_noise --seed 7 --repeats 5 --out mine
      cmmsim study frame_rate --set scenario.timing.latency_s=0.01 --out late
      cmmsim study frame_rate --out few \\
        --set 'scenario.timing.frame_rate_hz=[15.0,60.0]' --set repeats=5

    \b
    To define a kind of row of your own, put a function like this into a module on
    PYTHONPATH, write kind = "my_module:run" in the study, and allow the module by
    --plugin my_module:
      def run(scenario, seed, options):            # or run(scenario, seed)
          rng = numpy.random.default_rng(seed)     # a SeedSequence
          return {"error_um": ...}                 # numbers, units in names

    \b
    To use many machines, install this cmmsim, dask[distributed] and the files of
    the study on each; docs/howto/studies.md describes how to make certificates:
      dask scheduler --protocol tls                on one machine
      dask worker tls://HOST:8786 --nthreads 1     on each, once per core
      cmmsim study STUDY --scheduler tls://HOST:8786
    """
    if list_:
        _list()
        return
    if kinds:
        _list_kinds()
        return
    if name is None:
        raise typer.BadParameter(
            "name a built-in study or a TOML file, or ask for --list", param_hint="STUDY"
        )
    if scheduler is not None and workers is not None:
        raise typer.BadParameter(
            "--workers is for this machine, not for a running cluster", param_hint="--workers"
        )
    if scheduler is None and insecure:
        raise typer.BadParameter("--insecure is for --scheduler", param_hint="--insecure")
    from identify.studies.study_file import STUDIES, load_study

    if show:
        typer.echo(STUDIES.text(name)[0], nl=False)
        return
    given = {"seed": seed, "repeats": repeats}
    changes = parse_settings(settings) | {
        key: value for key, value in given.items() if value is not None
    }
    chosen = load_study(name).with_settings(changes)
    if chosen.rows > MANY_ROWS and not yes:
        raise StudyError(
            f"study {chosen.name!r} has {chosen.rows:,} rows; confirm more than {MANY_ROWS:,} rows "
            "by --yes"
        )
    folder = out or Path("runs") / f"study-{chosen.name}"
    count = cores() if workers is None else workers
    outcome, summary = _run(
        chosen, folder, count, scheduler, insecure, beside or [], terminal_progress(quiet, "rows/s")
    )
    tell(summary, json, quiet, lambda: _say(folder, outcome, summary["theory"]))
    _judge(outcome, summary["theory"])


def _run(
    study: "Study",
    folder: Path,
    workers: int,
    scheduler: str | None,
    insecure: bool,
    beside: list[Path],
    progress: Progress,
) -> "tuple[Outcome, dict[str, Any]]":
    """Run a study in its folder, and return its outcome and its summary."""
    with interruptible_imports():
        from identify.studies.processes import check_memory
        from identify.studies.runner import run_study
        from identify.studies.study_design import prepare
        from identify.studies.table import rows_beside

    shared = prepare(study)
    # The memory of the machines of a cluster is not known.
    if scheduler is None:
        check_memory(study, shared, max(workers, 1))
    others = rows_beside(study, beside)
    # Figures are drawn at the end only, because drawing takes seconds.
    so_far = partial(_summary, study, folder, figures=False)
    try:
        executor = workers_of(scheduler, workers, insecure)
        outcome = run_study(study, folder, progress, executor, so_far, shared)
    except StudyInterrupted as stopped:
        typer.echo(f"{stopped}; the same command goes on from there", err=True)
        raise typer.Exit(STOPPED) from None
    return outcome, _summary(study, folder, outcome.frame, others=others)


def workers_of(scheduler: str | None, workers: int, insecure: bool) -> "Workers":
    """Return the workers of a running cluster, of this machine, or this process if `workers` is 0.

    Raises StudyError if a cluster is named and Dask is missing.
    """
    if scheduler is not None:
        try:
            from identify.studies.dask_cluster import running_cluster
        except ImportError as error:
            raise StudyError(
                f"--scheduler needs Dask ({error}): pip install '.[cluster]' in a checkout"
            ) from None
        return partial(running_cluster, scheduler, insecure)
    if workers == 0:
        from identify.studies.runner import in_this_process

        return in_this_process
    from identify.studies.processes import local_processes

    return partial(local_processes, workers)


def _summary(study: "Study", folder: Path, frame: "pd.DataFrame", **how: Any) -> dict[str, Any]:
    """Write the summary of a table of rows, and return its content."""
    from identify.studies import summary
    from identify.studies.table import written

    with written(
        folder / summary.MARKDOWN, "; all rows are stored, and the same command writes it again"
    ):
        return summary.write(folder, study, frame, **how)


def _say(folder: Path, outcome: "Outcome", laws: list[dict[str, Any]]) -> None:
    for law in laws:
        typer.echo(_law_line(law))
    again = f", {outcome.found} of them from before" if outcome.found else ""
    again += f" ({outcome.surplus} rows of further repeats stay stored)" if outcome.surplus else ""
    figures = ", figures" if (folder / "figures").is_dir() else ""
    typer.echo(f"{outcome.rows} rows{again}; summary.md{figures} and study.parquet: {folder}")


def _judge(outcome: "Outcome", laws: list[dict[str, Any]]) -> None:
    """If rows or laws failed, say so on standard error, and exit with the status for this."""
    broken = [law for law in laws if law["verdict"] == "failed"]
    if broken:
        lines = "; ".join(map(_law_line, broken))
        typer.echo(f"{len(broken)} of {len(laws)} laws failed; {lines}", err=True)
    if outcome.failures:
        typer.echo(
            f"{len(outcome.failures)} of {outcome.rows} rows failed; {outcome.failures[0]}",
            err=True,
        )
        raise typer.Exit(ROWS_FAILED)
    if broken:
        raise typer.Exit(BEYOND_LIMIT)


def _law_line(law: dict[str, Any]) -> str:
    measured = law["reason"]
    if law["measured"] is not None:
        measured = (
            f"measured {law['measured']:.4g} ({law['low']:.4g} to {law['high']:.4g}), "
            f"expected {law['expected']}"
        )
    return f"{law['verdict']}: {law['statement']}: {measured}"


def _list() -> None:
    from identify.studies.study_file import STUDIES, load_study

    studies = [(name, load_study(name)) for name in STUDIES.names()]
    rows = [(name, f"{found.rows:,}", found.title) for name, found in studies]
    print_table(("study", "rows", "what it asks"), rows, ("study", "what it asks"))


def _list_kinds() -> None:
    from identify.studies.labels import factor_unit
    from identify.studies.rows import KINDS
    from identify.studies.study_design import valid_keys

    for kind in KINDS.values():
        typer.echo(
            f"{kind.name}: {kind.what}\n\nIt reads {kind.reads}, and its options. Other factors "
            "are refused.\n"
        )
        options = [
            (path, str(field.default), factor_unit(path), str(field.description))
            for path, field in valid_keys(kind.options).items()
            if path.startswith("options.")
        ]
        print_table(
            ("option", "default", "unit", "what it is"),
            options,
            ("option", "default", "unit", "what it is"),
        )
        figures = [
            (name, "" if column.unit == "1" else column.unit, column.meaning)
            for name, column in kind.columns.items()
        ]
        print_table(("figure", "unit", "what it is"), figures, ("figure", "unit", "what it is"))
        typer.echo()
