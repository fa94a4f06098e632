"""Commands about a robot alone: its base parameters, its workspace, its model in other engines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from identify.commands.help import Command, Commands
from identify.commands.options import JsonFile, Quiet, RobotArgument, new_folder, tell
from identify.errors import VerificationError
from identify.files.atomic import write_text
from identify.files.run_folder import new_run_folder, save_files
from identify.progress import print_advice, print_table, terminal_progress

if TYPE_CHECKING:
    from dynamics import Robot, RobotModel
    from identify.arrays import Array
    from identify.estimation.base_parameters import BaseParameters

THRESHOLD = 1e-3  # magnitude of an entry of R below which the paper counts it as zero (section 4.2)
PAPERS = "rss6"  # robot of the paper, for which the number in the paper's table is also printed
# Decimal exponents of the force units in which the paper's threshold is tried: N, kN, MN.
DECADES = (0, 3, 6)


def base_parameters(
    robot: RobotArgument = "rss6", json: JsonFile = None, quiet: Quiet = False
) -> None:
    """Print the base parameters of a robot: the combinations of dynamic parameters that a motion
    can identify.

    A parameter that stands alone can be identified by itself. A parameter in a sum can be
    identified only as part of that sum. The parameters listed after the sums have no effect on any
    motion. If only poses are measured, one common factor of all parameters remains unknown.

    Reads a robot file. Writes only the JSON, which has the coefficients of each combination.

    \b
    Examples:
      cmmsim base-parameters rss6
      cmmsim base-parameters mine.toml --json groups.json
    """
    from dynamics import load_robot
    from identify.estimation import base_parameters as base

    chosen = load_robot(robot)
    matrix = base.structural_regressor(chosen)
    found = base.base_parameters(matrix, chosen.layout)
    singular = base.rank_by_singular_values(matrix)
    angle = base.angle_to_singular_vectors(matrix, found)
    # The paper's threshold has a unit, so the rank depends on the units of the matrix.
    counts = {10**d: base.rank_by_threshold(matrix / 10**d, THRESHOLD) for d in DECADES}
    entry = _groups(found, singular, angle)
    tell(
        entry,
        json,
        quiet,
        lambda: _print_groups(
            found,
            singular,
            angle,
            counts,
            gains=len(chosen.layout.joint_pid_names),
            papers=chosen.name == PAPERS,
        ),
    )


def _print_groups(
    found: "BaseParameters",
    singular: int,
    angle: float,
    counts: dict[int, int],
    gains: int,
    papers: bool,
) -> None:
    for expression in found.expressions():
        typer.echo(expression)
    typer.echo(f"Parameters that no motion shows: {', '.join(found.unseen) or 'none'}.")
    typer.echo(
        f"The {len(found.names)} parameters make {found.rank} base parameters, which are all that "
        f"a motion can show; singular values find {singular}. Independent columns of the regressor "
        f"stand out of the others by at least {found.gap[1]:.1e} of their length, dependent "
        f"columns by at most {found.gap[0]:.1e}; both ways find the same groups to {angle:.1e} rad."
    )
    tried = ", ".join(f"{count} in units of {unit:g} N" for unit, count in counts.items())
    left = len(found.names) - len(found.unseen)
    typer.echo(
        f"The paper's rule, a diagonal of R above {THRESHOLD:g} without scaling, depends on the "
        f"units, and finds {tried}. Without the parameters that no motion shows, {left} remain, or "
        f"{left + gains} with the gains of the joint "
        f"controller{'; its table lists 49' if papers else ''}."
    )


def _groups(found: "BaseParameters", singular: int, angle: float) -> dict[str, Any]:
    groups = [
        {
            "name": name,
            "expression": text,
            "coefficients": {found.names[k]: row[k] for k in row.nonzero()[0]},
        }
        for name, text, row in zip(
            found.group_names(), found.expressions(), found.combinations, strict=True
        )
    ]
    return {
        "rank": found.rank,
        "rank_by_singular_values": singular,
        "angle_to_singular_vectors_rad": angle,
        "unseen": list(found.unseen),
        "groups": groups,
    }


def workspace(
    context: typer.Context,
    robot: RobotArgument = "rss6",
    out: Annotated[Path | None, new_folder("runs/workspace-ROBOT")] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Map the workspace of a robot around home: travel, reach and conditioning.

    Reads a robot file.

    Writes workspace.json, which is also the JSON, travel.png and conditioning.png into the folder.

    \b
    Example:
      cmmsim workspace mine.toml --out maps
    """
    from dynamics import load_robot
    from identify.verification.workspace_map import (
        conditioning_figure,
        map_workspace,
        travel_figure,
    )

    chosen = load_robot(robot)
    folder = context.with_resource(
        new_run_folder(out or Path("runs") / f"workspace-{chosen.name}")
    ).path
    found = map_workspace(chosen, terminal_progress(quiet))
    summary = found.summary()
    figures = {"travel.png": travel_figure(found), "conditioning.png": conditioning_figure(found)}
    save_files(folder, {**figures, "workspace.json": summary})
    tell(summary, json, quiet, lambda: _print_workspace(summary, folder))


def _print_workspace(summary: dict[str, Any], folder: Path) -> None:
    for axis, (low, high) in summary["range_from_home"].items():
        name, unit = axis.rsplit("_", 1)
        typer.echo(
            f"{name}: {1e3 * low:+.1f} to {1e3 * high:+.1f} m{unit} from home, within the joints' "
            "travel"
        )
    worst = summary["whole_travel"]
    typer.echo(
        "over the whole travel the actuators' leverage on their legs is at least "
        f"{worst['least_leverage_J_a1']:.3f}; the condition number of the legs' directions (J_a2) "
        f"is at most {worst['largest_condition_J_a2']:.2f}, and that of the whole Jacobian (J_ad) "
        f"{worst['largest_condition_J_ad']:.2f}"
    )
    typer.echo(f"maps: {folder}")


EXPORT_HELP = "Write a robot for another engine."

export = typer.Typer(
    name="export", cls=Commands, help=EXPORT_HELP, no_args_is_help=True, rich_markup_mode=None
)


@export.callback()
def _export() -> None:
    pass


OfResult = Annotated[
    str | None,
    typer.Option(
        metavar="SET|FILE",
        help="Parameter set of the robot, or the result.json of a run, whose estimates are used.",
        show_default="guess",
    ),
]
AllowUnphysical = Annotated[
    bool,
    typer.Option(
        "--allow-unphysical-inertia",
        help="If a body breaks Ix + Iy >= Iz, write the nearest inertia that engines accept.",
    ),
]


def _file(default: str) -> Any:
    return typer.Option(
        metavar="FILE",
        help="File to write. An existing file is replaced.",
        show_default=default,
    )


@export.command(cls=Command)
def mjcf(
    robot: RobotArgument,
    parameters: OfResult = None,
    out: Annotated[Path | None, _file("ROBOT.xml")] = None,
    allow_unphysical_inertia: AllowUnphysical = False,
    quiet: Quiet = False,
) -> None:
    """Write the robot as MJCF, a closed chain that MuJoCo loads.

    Reads a robot file, and the result.json that --parameters names. Writes one XML file.

    \b
    Examples:
      cmmsim export mjcf mine.toml --parameters truth --out mine.xml
      cmmsim export mjcf rss6 --parameters runs/paper-0/result.json \\
        --allow-unphysical-inertia
    """
    from dynamics.engines.mjcf import mjcf_text

    model, values = _chosen_model(robot, parameters)
    text = mjcf_text(
        model.robot, allow_unphysical_inertia=allow_unphysical_inertia, source=model.source
    )
    path = out or Path(f"{model.robot.name}.xml")
    write_text(path, text, parents=True)
    _tell_export(model.robot, values, [path], quiet)


@export.command(cls=Command)
def urdf(
    robot: RobotArgument,
    parameters: OfResult = None,
    out: Annotated[Path | None, _file("ROBOT.urdf")] = None,
    allow_unphysical_inertia: AllowUnphysical = False,
    quiet: Quiet = False,
) -> None:
    """Write the robot as URDF, with the closures of its loops in a YAML file of the same name.

    URDF knows only trees. The YAML file lists the frames that coincide in each closed loop, in the
    form that cmmsim import urdf reads. Effort and velocity of the joints are 1e9, because a robot
    file states no limits: put in those of your actuators.

    Reads a robot file, and the result.json that --parameters names. Writes two files.

    \b
    Example:
      cmmsim export urdf ups6 --parameters runs/ups6/result.json --out mine.urdf
    """
    from dynamics.engines.urdf import urdf_texts
    from identify.files.atomic import write_files

    model, values = _chosen_model(robot, parameters)
    texts = urdf_texts(model.robot, allow_unphysical_inertia=allow_unphysical_inertia)
    path = out or Path(f"{model.robot.name}.urdf")
    paths = [path, path.with_suffix(".yaml")]
    if paths[0] == paths[1]:
        raise typer.BadParameter(
            f"{path} is the name of the closures: name the URDF otherwise", param_hint="--out"
        )
    write_files({one: text.encode() for one, text in zip(paths, texts, strict=True)}, parents=True)
    _tell_export(model.robot, values, paths, quiet)


def _chosen_model(robot: str, parameters: str | None) -> "tuple[RobotModel, Array]":
    """Return the model of a robot with chosen parameters, and these parameters (p,)."""
    from dynamics import RobotModel, load_robot
    from identify.loop_parameters import choose_parameters

    chosen_robot = load_robot(robot)
    chosen = choose_parameters(chosen_robot, parameters)
    gains = chosen_robot.parameter_sets["guess"].joint_pid
    with_values = chosen_robot.with_parameters(np.concatenate([chosen.values, gains]))
    return RobotModel(with_values, chosen.source), chosen.values


def _tell_export(robot: "Robot", parameters: "Array", paths: list[Path], quiet: bool) -> None:
    if not quiet:
        from dynamics.inertia import described_changes

        for line in [*described_changes(robot, parameters), *(f"model: {path}" for path in paths)]:
            typer.echo(line)


def verify_model(
    context: typer.Context,
    robot: RobotArgument = "rss6",
    out: Annotated[Path | None, new_folder("runs/verify-ROBOT")] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Compare the model of a robot with MuJoCo in the loop of figure 7 of the paper.

    Reads a robot file.

    Writes verification.json, which is also the JSON, and figure8.png into the folder.

    \b
    Example:
      cmmsim verify-model rss6
    """
    from dynamics import load_robot
    from identify.verification.against_mujoco import figure_8, verification_entry, verify

    chosen = load_robot(robot)
    folder = context.with_resource(
        new_run_folder(out or Path("runs") / f"verify-{chosen.name}")
    ).path
    runs = verify(chosen, terminal_progress(quiet))
    entry = verification_entry(chosen, robot, runs)
    save_files(folder, {"verification.json": entry, "figure8.png": figure_8(runs)})
    tell(entry, json, quiet, lambda: _print_verdict(entry, folder))
    if not entry["met"]:
        found = entry["difference"]
        goal = entry["goal"]
        raise VerificationError(
            f"model and MuJoCo differ by {found['position_steady_um']:.3g} um and "
            f"{found['angle_steady_urad']:.3g} urad, more than {goal['position_steady_um']:g} um "
            f"and {goal['angle_steady_urad']:g} urad; see {folder}"
        )


def _print_verdict(entry: dict[str, Any], folder: Path) -> None:
    found = entry["difference"]
    goal = entry["goal"]
    paper = entry["paper"]
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
    rows.append(("torque, whole run", entry["torque_unit"], f"{found['torque_max']:.2g}", "", ""))
    rows.append(("MuJoCo's loop closure", "um", f"{found['closure_max_um']:.2g}", "", ""))
    print_table(
        ("largest difference", "unit", "value", "goal", "paper"),
        rows,
        ("largest difference", "unit"),
        title,
    )
    if advice := entry["advice"]:
        print_advice(**advice)
    typer.echo(f"figure: {folder / 'figure8.png'}")
