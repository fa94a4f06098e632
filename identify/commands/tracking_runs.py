"""Command ``track``: how much control laws gain from a model of the robot."""

from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.options import (
    JsonFile,
    Plugins,
    Quiet,
    RobotOption,
    ScenarioArgument,
    Seed,
    Settings,
    allow_named,
    chosen_scenario,
    new_folder,
    repeatable,
    tell,
)
from identify.errors import ScenarioError
from identify.files.run_folder import new_run_folder, save_files
from identify.own_parts import LAWS
from identify.progress import print_table, terminal_progress

ALL = "all"


def track(
    context: typer.Context,
    scenario: ScenarioArgument = "quick",
    law: Annotated[
        list[str] | None,
        repeatable(f"Law: {', '.join(LAWS)}, module:function, or {ALL}", "the scenario's"),
    ] = None,
    model: Annotated[
        list[str] | None,
        repeatable(f"Model that the law knows: initial, identified, true, or {ALL}", ALL),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            metavar="DIR",
            help="Folder of a run whose estimates are the identified model. Without it, such a "
            "run is made.",
        ),
    ] = None,
    motion: Annotated[
        Path | None,
        typer.Option(
            "--motion",
            metavar="FILE",
            help="CSV file of poses to follow in place of the standard motions.",
        ),
    ] = None,
    out: Annotated[Path | None, new_folder("runs/track-SCENARIO-SEED")] = None,
    seed: Seed = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Follow motions under control laws that know a model of the robot.

    The simulated robot follows the scenario's validation trajectories, a circle and a square, with
    images in the loop. The laws are the paper's servo (pid), joint commands shaped by the inverse
    dynamics (feedforward), and torques (computed_torque). Laws other than pid know the initial
    guess of the model, the identified model, or the true model. The results are the errors of the
    true poses, the effort, and the share of the squared error that an exact sensor, an exact model
    or zero latency would remove. The scenario's [control] states the limits of the actuators, and
    whether an observer predicts the pose.

    Reads a scenario, the folder of a finished run that --run names, and a CSV file of poses that
    --motion names, with the columns t, x, y, z, alpha, beta, gamma in s, m and rad.

    Writes track.json, which is also the JSON, and scenario.toml.

    \b
    Examples:
      cmmsim track quick --law all --model all
      cmmsim track quick --law feedforward --model identified --run DIR
      cmmsim track --law computed_torque --set control.observer=false
      cmmsim track --law feedforward --model true --motion poses.csv
    """
    from dynamics.errors import SimulationError
    from identify.setup import Setup
    from identify.tracking.track import MODELS
    from identify.tracking.track import track as follow_all

    chosen = chosen_scenario(scenario, settings, robot)
    allow_named(law)
    laws = _each(law or [chosen.control.law], tuple(LAWS))
    models = _each(model or [ALL], MODELS)
    unknown = [name for name in models if name not in MODELS]
    if unknown:
        raise ScenarioError(f"unknown model {unknown[0]!r}; valid: {', '.join(MODELS)}, or {ALL}")
    folder = context.with_resource(
        new_run_folder(out or Path("runs") / f"track-{chosen.name}-{seed}")
    ).path
    progress = terminal_progress(quiet)
    setup = Setup(chosen, seed, progress=progress).on_this_machine()
    entry = follow_all(setup, laws, models, progress, run, motion)
    save_files(folder, {"track.json": entry, "scenario.toml": chosen.to_toml()})
    tell(entry, json, quiet, lambda: _print(entry, folder))
    first = entry["runs"][0]
    if all("failed" in run for run in entry["runs"]):
        raise SimulationError(
            f"no law kept the robot on its motion; {_called(first)}: {first['failed']}"
        )


def _each(given: list[str], every: tuple[str, ...]) -> list[str]:
    # A dict drops repeated names and preserves their order.
    return list(dict.fromkeys(name for one in given for name in (every if one == ALL else (one,))))


def _called(run: dict[str, Any]) -> str:
    return f"{run['law']} with the {run['model']} model" if run["model"] else str(run["law"])


def _print(entry: dict[str, Any], folder: Path) -> None:
    done = [run for run in entry["runs"] if "failed" not in run]
    if done:
        _print_tables(done, entry["effort_unit"])
    # If all runs have failed, the error message of the command describes the first.
    for run in entry["runs"] if done else entry["runs"][1:]:
        if "failed" in run:
            typer.echo(f"lost: {_called(run)}: {run['failed']}")
        elif run["saturated_frames"]:
            where = f"in {run['saturated_frames']} of {run['frames']} frames"
            typer.echo(f"{_called(run)}: an actuator is at its limit {where}")
    typer.echo(f"files: {folder}")


def _print_tables(done: list[dict[str, Any]], effort_unit: str) -> None:
    errors = [
        (
            run["law"],
            run["model"] or "–",
            *map(_rounded, (*run["position_rms_um"], *run["orientation_rms_urad"])),
        )
        for run in done
    ]
    header = ("law", "model", "x\num", "y\num", "z\num", "alpha\nurad", "beta\nurad", "gamma\nurad")
    print_table(header, errors, header[:2], "rms error of the followed poses")
    shares = [
        (
            run["law"],
            run["model"] or "–",
            f"{run['effort_rms']:.3g}",
            *(_percent(share["position"]) for share in run["shares"].values()),
        )
        for run in done
    ]
    effort_header = ("law", "model", f"effort\n{effort_unit}", "sensor", "model", "latency", "rest")
    said = (
        "rms effort, and the share of the squared position error that an exact sensor, an exact "
        "model or zero latency would remove"
    )
    print_table(effort_header, shares, header[:2], said)


def _percent(share: float) -> str:
    return f"{round(100 * share)} %" if isfinite(share) else "–"


def _rounded(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"
