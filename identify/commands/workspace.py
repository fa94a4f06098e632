"""The command ``cmmsim workspace``. Heavy imports are late."""

import json
from pathlib import Path
from typing import Annotated

import typer

from identify.progress import terminal_progress


def workspace(
    robot: Annotated[str, typer.Argument(help="Built-in robot (rss6) or path of a TOML file.")] = "rss6",
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder, new or empty.", show_default="runs/workspace-ROBOT")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no summary.")] = False,
) -> None:
    """Map travel, reach and conditioning around home: writes workspace.json, travel.png and conditioning.png."""
    from dynamics import load_robot
    from identify.files.atomic import write_text
    from identify.files.run_folder import new_run_folder
    from identify.reporting.figures import save_figure
    from identify.verification.workspace_map import conditioning_figure, map_workspace, travel_figure

    chosen = load_robot(robot)
    folder = new_run_folder(out or Path("runs") / f"workspace-{chosen.name}").path
    found = map_workspace(chosen, terminal_progress(quiet))
    folder.mkdir(parents=True, exist_ok=True)
    save_figure(travel_figure(found), folder / "travel.png")
    save_figure(conditioning_figure(found), folder / "conditioning.png")
    summary = found.summary()
    write_text(folder / "workspace.json", json.dumps(summary, indent=2) + "\n")
    if quiet:
        return
    for axis, (low, high) in summary["range_from_home"].items():
        name, unit = axis.rsplit("_", 1)
        typer.echo(f"{name}: {1e3 * low:+.1f} to {1e3 * high:+.1f} m{unit} from home within travel")
    worst = summary["whole_travel"]
    typer.echo(
        f"whole travel: leverage (J_a1) at least {worst['least_leverage_J_a1']:.3f}, condition of J_a2 at most "
        f"{worst['largest_condition_J_a2']:.2f}, of J_ad {worst['largest_condition_J_ad']:.2f}"
    )
    typer.echo(f"maps: {folder}")
