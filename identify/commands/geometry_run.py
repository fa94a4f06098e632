"""Command ``geometry``: calibration of a robot's joints, axes and zero angles."""

from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.options import (
    JsonFile,
    Plugins,
    Quiet,
    RobotOption,
    ScenarioArgument,
    Settings,
    chosen_scenario,
    new_folder,
    tell,
)
from identify.files.run_folder import new_run_folder
from identify.progress import print_table, print_warnings, terminal_progress


def geometry(
    context: typer.Context,
    scenario: ScenarioArgument = "geometry",
    out: Annotated[Path | None, new_folder("runs/geometry-SEED")] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Seed of poses, offsets and noise.")
    ] = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    poses: Annotated[
        Path | None,
        typer.Option("--poses", metavar="FILE", help="Your own poses in place of simulated ones."),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Calibrate the geometry of a robot with the optical CMM.

    The robot stands still at poses chosen for the most information about its geometry. At each pose
    the encoders measure the joint coordinates, and the mean of some frames is the measured pose.
    Joint positions, axes, zero angles and lengths are estimated, each with its standard deviation.
    Numbers and combinations that the poses do not determine keep the values of the robot file, and
    are listed. The scenario's [geometry] has the settings; its [plant] has the geometry errors of
    the simulated robot.

    Reads a scenario, and with --poses a JSON file like poses.json: joints (N, n) in rad or m,
    joint_std (n,), poses (N, 6) in m and rad and covariances (N, 6, 6). The optional
    base_covariance and platform_covariance, each (6, 6), state how well the base and platform
    frames are known. Writes geometry.json, which is also the JSON, geometry.md, geometry.png,
    geometry.svg, covariance.nc, poses.json, scenario.toml and robot.toml, the calibrated robot.
    Every other command reads robot.toml; cmmsim run --set geometry.known=FILE also its covariance.

    \b
    Examples:
      cmmsim geometry
      cmmsim geometry --robot ups6 --set geometry.measurement=drawn
      cmmsim geometry --set geometry.poses=30 --set geometry.selection=random
      cmmsim geometry --robot mine.toml --poses measured.json
      cmmsim run quick --set geometry.known=runs/geometry-0/robot.toml
    """
    from dynamics import load_robot
    from identify.geometry.before_a_run import run_geometry
    from identify.geometry.static_poses import read_static_poses
    from identify.reporting.figures.geometry_calibration import geometry_figure
    from identify.reporting.figures.style import drawn, svg_text
    from identify.setup import Setup

    chosen = chosen_scenario(scenario, settings, robot)
    folder = context.with_resource(new_run_folder(out or Path("runs") / f"geometry-{seed}")).path
    own = None if poses is None else read_static_poses(poses, load_robot(chosen.robot))
    setup = Setup(chosen, seed).on_this_machine()
    outcome = run_geometry(setup, terminal_progress(quiet), own)
    picture = drawn(lambda: geometry_figure(outcome.entry))
    outcome.write(folder, {"geometry.png": picture, "geometry.svg": svg_text(picture, "geometry")})
    print_warnings(outcome.entry["warnings"])
    tell(outcome.entry, json, quiet, lambda: _print(outcome.entry, folder))


def _print(entry: dict[str, Any], folder: Path) -> None:
    import numpy as np

    errors = [
        (said, [*entry[key]["position_rms_um"], *entry[key]["orientation_rms_urad"]])
        for key, said in (
            ("uncalibrated", "before"),
            ("unseen", "after"),
            ("expected", "expected after"),
        )
        if key in entry
    ]
    rows = [
        (said, *(f"{value:.2f}" for value in row)) for said, row in errors if np.isfinite(row).all()
    ]
    header = ("", "x\num", "y\num", "z\num", "alpha\nurad", "beta\nurad", "gamma\nurad")
    print_table(header, rows, (), "rms error of poses that were not measured")
    known = [name for name, one in entry["parameters"].items() if one["observable"]]
    typer.echo(
        f"{entry['poses']} poses determine {len(known)} of {len(entry['parameters'])} geometric "
        f"numbers; {len(entry['cannot_be_told'])} combinations remain undetermined"
    )
    typer.echo(f"files: {folder}")
