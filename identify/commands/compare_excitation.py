"""What ``cmmsim excite --compare`` does. Heavy imports are late."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from identify.progress import Progress, print_table
from identify.scenario import Scenario

if TYPE_CHECKING:
    from identify.excitation.comparison import Comparison, Entry

PAPER = "the paper, with its own robot and geometry: index 0.38 at the start, 1.345 after 324 generations"
HEADER = ("method", "value", "eq. 39", "D", "seconds", "values", "gradients", "stopped")


def compare(scenario: Scenario, seed: int, folder: Path, progress: Progress, quiet: bool) -> None:
    """Search with every method: writes comparison.json and comparison.png into `folder`."""
    from dataclasses import asdict

    from dynamics import load_robot
    from identify.excitation.comparison import compare_methods, comparison_figure
    from identify.files.run_folder import save_files

    robot = load_robot(scenario.robot)
    found = compare_methods(robot, scenario, seed, progress)
    figures = {**asdict(found), "entries": [entry.figures() for entry in found.entries], "scenario": scenario.name}
    figure = comparison_figure(robot, scenario, found)
    save_files(folder, {"comparison.json": figures, "comparison.png": figure})
    if not quiet:
        print_comparison(found, folder)


def print_comparison(found: "Comparison", folder: Path) -> None:
    """One row a method, and what is nearest to its limit."""
    title = f"criterion {found.criterion}, seed {found.seed}, {found.candidates} random candidates"
    print_table(HEADER, map(_row, found.entries), ("method", "stopped"), title, PAPER)
    for entry in found.entries:
        nearest = sorted(entry.worst, key=lambda worst: -worst.share)
        used = ", ".join(f"{worst.name} {100 * worst.share:.2f} %" for worst in nearest)
        typer.echo(f"{entry.method}: share of each limit used: {used}")
    typer.echo(
        f"value: what was maximised (information: D of the linearised loop). D: factor by which a run narrows the "
        f"prior, simulated loop; - where it is unstable. Candidates and functions: {found.preparation_seconds:.1f} s. "
        f"Files: {folder}"
    )


def _row(entry: "Entry") -> tuple[str, ...]:
    information = "-" if entry.information is None else f"{entry.information:.3f}"
    return (
        entry.method,
        f"{entry.value:.4f}",
        f"{entry.observability:.4f}",
        information,
        f"{entry.seconds:.1f}",
        str(entry.evaluations),
        str(entry.gradients),
        entry.reason.replace("_", " "),
    )
