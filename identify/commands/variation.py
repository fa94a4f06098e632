"""The command ``cmmsim variation``. Heavy imports are late."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from identify.files.run_folder import RunFolder, save_files
from identify.progress import Progress, print_table, terminal_progress

if TYPE_CHECKING:
    import xarray as xr

    from dynamics import Robot
    from identify.reporting.tables import Table
    from identify.scenario import Scenario
    from identify.validation.variation import Variation


def variation(
    out: Annotated[Path, typer.Option("--out", help="Folder of a whole run: cmmsim run.")],
    designed: Annotated[
        int | None,
        typer.Option(
            "--designed",
            min=3,
            metavar="COUNT",
            help="Record this many new runs, each on an exciting trajectory designed for it by the scenario's method, "
            "instead of taking the unseen runs.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes that design and render.", show_default="one a core"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no table.")] = False,
) -> None:
    """Identify from each of several runs alone, and see how the estimates vary (the paper's table 5).

    As in the paper, from the unseen runs of validation.nc; or from newly recorded ones, which are kept as variation.nc.
    Writes variation.json, variation.md and figures/variation.png.

    The masses of the links vary most: only what accelerates shows them. Fast trajectories tell more of them than long
    ones: cmmsim excite paper --set excitation.fundamental_hz=0.3 --out fast, then cmmsim variation --out fast
    --designed 10.
    """
    from dynamics import load_robot
    from identify.record import recording
    from identify.record.provenance import check_folder
    from identify.reporting.variation_tables import variation_table
    from identify.scenario import load_scenario
    from identify.validation.variation import identify_each
    from identify.validation.variation import variation as variation_of

    folder = RunFolder(out)
    folder.require("scenario.toml", *(["trajectories.json"] if designed else ["validation.nc"]))
    if not designed:
        check_folder(folder, "validation.nc")
    progress = terminal_progress(quiet)
    scenario = load_scenario(folder.scenario)
    robot = load_robot(scenario.robot)
    records = (
        _record_designed(folder, scenario, robot, designed, workers, progress)
        if designed
        else recording.read_runs(folder.validation)
    )
    found = variation_of(identify_each(records, robot, scenario, progress))
    table = variation_table(found)
    _write(folder, found, f"designed: {scenario.excitation.method}" if designed else "unseen", table)
    if not quiet:
        _print(table, *found.worst, out)


def _record_designed(
    folder: RunFolder, scenario: "Scenario", robot: "Robot", count: int, workers: int | None, progress: Progress
) -> list["xr.Dataset"]:
    from identify.record import recording
    from identify.trajectory import load_trajectories
    from identify.validation.variation import designed_runs

    seed = load_trajectories(folder.trajectories).seed
    runs = designed_runs(scenario, robot, seed, count, workers, progress)
    recording.write_runs(folder.path / "variation.nc", [(run.record, run.truth) for run in runs])
    return [run.record for run in runs]


def _write(folder: RunFolder, found: "Variation", runs: str, table: "Table") -> None:
    from identify.reporting.variation_tables import variation_entry, variation_figure

    files = {
        "variation.json": variation_entry(found, runs),
        "variation.md": f"# {table.title}\n\n{table.markdown()}\n\n{table.note}\n",
        "figures/variation.png": variation_figure(found),
    }
    save_files(folder.path, files)


def _print(table: "Table", name: str, worst: float, out: Path) -> None:
    print_table(table.header, table.rows, ("parameter", "unit"), table.title, table.note)
    typer.echo(f"largest: {100 * worst:.3g} % of {name}; files: {out}")
