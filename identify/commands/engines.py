"""Commands around other engines: ``cmmsim export mjcf`` and ``cmmsim verify-model``. Heavy imports are late."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.errors import OutputFolderError, VerificationError
from identify.progress import print_table, terminal_progress

if TYPE_CHECKING:
    from dynamics import Robot
    from identify.arrays import Array

EXPORT_HELP = """
Write a robot for another engine.

\b
Examples:
  cmmsim export mjcf rss6 --parameters runs/paper-0/result.json --allow-unphysical-inertia
  cmmsim export mjcf mine.toml --parameters identified --out mine.xml
"""

export = typer.Typer(name="export", help=EXPORT_HELP, no_args_is_help=True, rich_markup_mode=None)

RobotArgument = Annotated[str, typer.Argument(help="Built-in robot (rss6) or path of a TOML file.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars and no summary.")]


@export.callback()
def _export() -> None:
    pass


@export.command()
def mjcf(
    robot: RobotArgument,
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="SET|FILE",
            help="Parameter set of the robot, or result.json of a run: its estimates.",
            show_default="initial",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write; replaced if there.", show_default="ROBOT.xml")
    ] = None,
    allow_unphysical_inertia: Annotated[
        bool,
        typer.Option(
            "--allow-unphysical-inertia",
            help="Where a body breaks Ix + Iy >= Iz, write the nearest inertia that MuJoCo accepts.",
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write the robot as MJCF, a closed chain that MuJoCo loads."""
    from dynamics import load_robot
    from dynamics.engines.mjcf import mjcf_text
    from identify.loop_parameters import choose_parameters

    with terminal_progress(quiet).stage("export", 1) as advance:
        chosen_robot = load_robot(robot)
        chosen = choose_parameters(chosen_robot, parameters)
        allowed = allow_unphysical_inertia
        text = mjcf_text(chosen_robot, chosen.values, allow_unphysical_inertia=allowed, source=chosen.source)
        path = out or Path(f"{chosen_robot.name}.xml")
        _write(path, text)
        advance()
    if not quiet:
        for line in [*_changes(chosen_robot, chosen.values), f"model: {path}"]:
            typer.echo(line)


def _changes(robot: "Robot", parameters: "Array") -> list[str]:
    """Lines: the inertias that the export changed, and by how much that changes the robot's accelerations."""
    from dynamics.inertia import acceleration_changes, grouped, physical_inertias

    inertias = physical_inertias(parameters, allow_changes=True)
    if not inertias.changes:
        return []
    effects = acceleration_changes(robot, parameters, inertias.values)
    said = {body: f"{change}; {_effect(effects[body])}" for body, change in inertias.changes.items()}
    return [f"changed {line}" for line in grouped(said)]


def _effect(change: float) -> str:
    return f"accelerations differ by up to {100 * change:.2g} %" if change > 1e-9 else "the motion does not feel it"


def verify_model(
    robot: RobotArgument = "rss6",
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder, new or empty.", show_default="runs/verify-ROBOT")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Compare the model with MuJoCo in the paper's loop (figure 7): writes verification.json and figure8.png."""
    from dynamics import load_robot
    from identify.files.run_folder import new_run_folder, save_result
    from identify.reporting.figures import save_figure
    from identify.verification import figure7 as model_verification
    from identify.verification.figure7 import figure_8

    chosen = load_robot(robot)
    folder = new_run_folder(out or Path("runs") / f"verify-{chosen.name}").path
    runs = model_verification.verify(chosen, terminal_progress(quiet))
    entry = model_verification.verification_entry(chosen, runs)
    save_result(folder / "verification.json", entry)
    save_figure(figure_8(runs), folder / "figure8.png")
    if not quiet:
        _print_verdict(entry, folder)
    if not entry["met"]:
        found, goal = entry["difference"], entry["goal"]
        raise VerificationError(
            f"model and MuJoCo differ by {found['position_steady_um']:.3g} um and {found['angle_steady_urad']:.3g} urad"
            f", more than {goal['position_steady_um']:g} um and {goal['angle_steady_urad']:g} urad; see {folder}"
        )


def _print_verdict(entry: dict[str, Any], folder: Path) -> None:
    found, goal, paper = entry["difference"], entry["goal"], entry["paper"]
    title = f"{entry['robot']}: MuJoCo {entry['mujoco']['version']} against this model"
    rows = []
    for label, key in (
        ("position, whole run", "position_max_um"),
        ("position, steady", "position_steady_um"),
        ("angle, whole run", "angle_max_urad"),
        ("angle, steady", "angle_steady_urad"),
    ):
        limit = f"{goal[key]:g}" if key in goal else ""
        rows.append((label, key.rpartition("_")[2], f"{found[key]:.2g}", limit, f"{paper[key]:g}"))
    rows.append(("torque, whole run", "N m", f"{found['torque_max_nm']:.2g}", "", ""))
    rows.append(("MuJoCo's loop closure", "um", f"{found['closure_max_um']:.2g}", "", ""))
    print_table(("largest difference", "unit", "value", "goal", "paper"), rows, ("largest difference", "unit"), title)
    typer.echo(f"figure: {folder / 'figure8.png'}")


def _write(path: Path, text: str) -> None:
    from identify.files.atomic import write_text

    try:
        write_text(path, text)
    except (OSError, ValueError) as error:  # ValueError: a robot's name that no file can have
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise OutputFolderError(f"cannot write {path}: {reason}; name another file with --out") from None
