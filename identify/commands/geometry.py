"""The command ``geometry``: where a robot's joints, axes and zero angles are. Heavy imports are late."""

from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands import new_folder
from identify.files.run_folder import new_run_folder
from identify.progress import print_table, print_warnings, terminal_progress

GEOMETRY_HELP = """
Calibrate the geometry of a robot with the optical CMM: writes geometry.json, geometry.md, robot.toml, covariance.nc and
poses.json.

The robot stands at poses that show most of its geometry. Joint encoders read its joints, the mean of some frames its
pose; joint places, axes, zero angles and lengths follow, each with its standard deviation. Numbers and combinations
that the poses cannot tell stay where the robot file has them, and are named. robot.toml is the calibrated robot, which
every other command takes. The scenario's [geometry] says how; its [plant] how far the simulated robot is off.

With --poses, the poses are your own: a JSON file with joints (N, n) in rad or m, joint_std (n,), poses (N, 6) in m and
rad and covariances (N, 6, 6), as poses.json is; base_covariance and platform_covariance (6, 6) say how well the frames
of the measurement are known, and are left out where they are not.

\b
Examples:
  cmmsim geometry                            sixty poses of rss6, through images
  cmmsim geometry --robot ups6 --set geometry.measurement=drawn
  cmmsim geometry --set geometry.poses=30 --set geometry.selection=random
  cmmsim geometry --robot mine.toml --poses measured.json
  cmmsim run quick --robot runs/geometry-0/robot.toml
"""


def geometry(
    scenario: Annotated[str, typer.Argument(help="Built-in scenario or path of a TOML file.")] = "geometry",
    out: Annotated[Path | None, new_folder("runs/geometry-SEED")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of poses, offsets and noise.")] = 0,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot", metavar="NAME|FILE", help="Another robot than the scenario's.", show_default="scenario's"
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace a value: geometry.poses=30.")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option("--poses", metavar="FILE", help="Your own poses in place of simulated ones.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no summary; warnings stay.")] = False,
) -> None:
    """See `GEOMETRY_HELP`."""
    from dynamics import load_robot
    from identify.commands.app import parse_settings
    from identify.geometry.run import run_geometry
    from identify.geometry.static_poses import read_static_poses
    from identify.scenario import load_scenario

    changes = ({} if robot is None else {"robot": robot}) | parse_settings(settings)
    chosen = load_scenario(scenario).with_overrides(changes)
    folder = new_run_folder(out or Path("runs") / f"geometry-{seed}").path
    own = None if poses is None else read_static_poses(poses, load_robot(chosen.robot))
    outcome = run_geometry(chosen, seed, terminal_progress(quiet), own)
    outcome.write(folder)
    print_warnings(outcome.entry["warnings"])
    if not quiet:
        _print(outcome.entry, folder)


def _print(entry: dict[str, Any], folder: Path) -> None:
    rows = [
        (said, *(f"{value:.2f}" for value in (*entry[key]["position_rms_um"], *entry[key]["orientation_rms_urad"])))
        for key, said in (("uncalibrated", "before"), ("unseen", "after"), ("expected", "expected after"))
        if key in entry
    ]
    header = ("", "x\num", "y\num", "z\num", "alpha\nurad", "beta\nurad", "gamma\nurad")
    print_table(header, rows, (), "rms error of poses that were not measured")
    told = [name for name, one in entry["parameters"].items() if one["observable"]]
    typer.echo(
        f"{len(told)} of {len(entry['parameters'])} geometric numbers are told by {entry['poses']} poses; "
        f"{len(entry['cannot_be_told'])} combinations cannot be told"
    )
    typer.echo(f"files: {folder}")
