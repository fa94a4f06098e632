"""Commands of an experiment: a whole run, or its stages one by one."""

from pathlib import Path
from typing import Annotated, Any

import typer

from identify.commands.comparisons import compare_excitation
from identify.commands.options import (
    STANDARD_OUTPUT,
    EstimatorSettings,
    JsonFile,
    NewFolder,
    Plugins,
    Quiet,
    RobotOption,
    RunFolderOption,
    ScenarioArgument,
    Seed,
    Settings,
    Strict,
    Workers,
    chosen_scenario,
    parse_settings,
    tell,
)
from identify.errors import VerificationError
from identify.files.lock import lock_folder
from identify.files.run_folder import (
    BEGUN,
    UNFINISHED,
    RunFolder,
    load_result,
    new_run_folder,
    refuse_finished,
)
from identify.progress import print_warnings, terminal_progress, with_plugins
from identify.runtime import interruptible_imports

# Files that the first two stages write.
PLANNED = ("scenario.toml", "trajectories.json", "experiment.nc")


def run(
    context: typer.Context,
    scenario: ScenarioArgument = "paper",
    out: NewFolder = None,
    seed: Seed = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    workers: Workers = None,
    strict: Strict = False,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Run a whole experiment, from designing the motion to the report.

    Chooses an exciting trajectory, moves the simulated robot along it with images in the loop,
    identifies the robot from the record, validates the model on further trajectories, and writes
    the report. A missed goal is reported, also with --quiet, and changes the exit status only with
    --strict.

    Reads a scenario, and the robot and sensor that it names.

    Writes into the folder: scenario.toml, trajectories.json, experiment.nc, result.json,
    covariance.nc, validation.nc, model.nc, report.html and figures; the folder geometry with
    geometry.known=calibrated; payload.nc if a payload fixes the scale. The JSON is result.json.

    \b
    Examples:
      cmmsim run quick                        a short run into runs/quick-0
      cmmsim run                              the paper's experiment
      cmmsim run paper --seed 7 --out mine    other noise and trajectories
      cmmsim run quick --robot ups6           another robot, or your own file
      cmmsim run quick --set timing.latency_s=0.0167 --set pose_method=planes
      cmmsim run quick --set plant.geometry_error_m=1e-4
                                              joints off by 0.1 mm: a wrong
                                              model, seen in the residuals
    """
    chosen = chosen_scenario(scenario, settings, robot)
    path = out or Path("runs") / f"{chosen.name}-{seed}"
    # A finished run is refused before anything that takes long.
    refuse_finished(path)
    with interruptible_imports():
        from identify.setup import Setup
        from identify.verification.robot_check import run_warning

    setup = Setup(chosen, seed).on_this_machine()
    # An experiment that was begun in this folder is continued, so its files are allowed there.
    begun = _pipeline().is_begun(setup, path)
    folder = context.with_resource(new_run_folder(path, BEGUN if begun else UNFINISHED))
    if not begun:
        said = run_warning(setup, terminal_progress(quiet))
        print_warnings([said] if said else [])
    _pipeline().run(setup, folder.path, terminal_progress(quiet), workers)
    result = _warned(folder)
    tell(result, json, quiet, lambda: _summary().print_goals(result, folder.report))
    _tell_missed(result, quiet or str(json) == STANDARD_OUTPUT, strict)


def warm_up(
    scenario: ScenarioArgument = "paper",
    robot: RobotOption = None,
    settings: Settings = None,
    all_robots: Annotated[
        bool, typer.Option("--all-robots", help="Also compile every built-in robot.")
    ] = False,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Compile all machine code that runs of a scenario need, so that later runs do not wait for it.

    Each robot has machine code of its own. The loop is compiled once for each number of joints and
    degrees of freedom.

    Reads a scenario and its robot. Writes machine code into the cache folder of this user, or into
    the folder that the variable CMMSIM_CACHE names.

    \b
    Examples:
      cmmsim warm-up
      cmmsim warm-up quick --robot mine.toml
    """
    with interruptible_imports():
        from dynamics import built_in_robots
        from identify.experiment.warm_up import warm_up
        from identify.setup import Setup

    setup = Setup(chosen_scenario(scenario, settings, robot)).on_this_machine()
    others = set(built_in_robots()) - {setup.scenario.robot} if all_robots else ()
    warm_up(setup.plant, setup.sensor_plan, terminal_progress(quiet), tuple(others))


def excite(
    context: typer.Context,
    scenario: ScenarioArgument = "paper",
    out: NewFolder = None,
    seed: Seed = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Only compare the search methods, and write comparison.json and comparison.png.",
        ),
    ] = False,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Choose the exciting and the validation trajectories: the first stage of an experiment.

    Reads a scenario and its robot.

    Writes scenario.toml and trajectories.json into the folder, and the folder geometry with
    geometry.known=calibrated. With --compare, it writes only a comparison of all search methods.
    The JSON is trajectories.json or comparison.json.

    \b
    Examples:
      cmmsim excite quick --out mine
      cmmsim excite paper --compare           random, evolutionary and gradient
                                              search side by side
    """
    chosen = chosen_scenario(scenario, settings, robot)
    name = f"excite-{chosen.name}-{seed}" if compare else f"{chosen.name}-{seed}"
    # Files of an interrupted search are allowed there, and are replaced.
    may_hold = () if compare else UNFINISHED
    folder = context.with_resource(new_run_folder(out or Path("runs") / name, may_hold))
    with interruptible_imports():
        from identify.setup import Setup

    setup = Setup(chosen, seed).on_this_machine()
    if compare:
        compare_excitation(setup, folder.path, terminal_progress(quiet), json, quiet)
        return
    _pipeline().excite(setup, folder.path, terminal_progress(quiet))
    tell(
        load_result(folder.trajectories),
        json,
        quiet,
        lambda: _wrote(folder.trajectories, "record"),
    )


def _wrote(path: Path, stage: str) -> None:
    """Print which file of a run was written, and the command of the next stage."""
    command = with_plugins(f"cmmsim {stage} --out {path.parent}")
    typer.echo(f"wrote {path}; next: {command}")


def record(
    context: typer.Context,
    out: RunFolderOption,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Move the simulated robot along the exciting trajectory with images in the loop: the second
    stage.

    Reads scenario.toml and trajectories.json from the folder.

    Writes experiment.nc there: the record, and the truth in a group of its own. If a payload fixes
    the scale, it also writes payload.nc.

    \b
    Example:
      cmmsim record --out mine
    """
    RunFolder(out).require("scenario.toml", "trajectories.json")
    context.with_resource(lock_folder(out))
    _pipeline().record(out, terminal_progress(quiet))
    if not quiet:
        _wrote(RunFolder(out).experiment, "identify")


def identify(
    context: typer.Context,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder of the run, with the files of the stage before; with --record a new "
            "folder.",
            show_default="with --record: runs/NAME-OF-THE-RECORD",
        ),
    ] = None,
    record: Annotated[
        list[Path] | None,
        typer.Option(
            "--record",
            metavar="FILE",
            help="Identify from a record of your own: netCDF, CSV, or a log of Motive, Vicon or "
            "ROS 2. Repeat the option for further records of the same robot: other motions, days, "
            "settings or loads.",
            show_default=False,
        ),
    ] = None,
    settings: EstimatorSettings = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Estimate the robot's parameters from the record: the third stage.

    Reads scenario.toml, trajectories.json and experiment.nc from the folder, or a record of your
    own. A record of your own is a netCDF file like experiment.nc, or a CSV table beside a TOML file
    of the same name that describes the experiment. cmmsim new record mine.csv writes templates of
    both, with comments that explain the columns and the rules below. Its option --from describes a
    log of another program: an export of Motive or Vicon, or a bag of ROS 2 or MCAP.

    Units are m, rad and s. If the rows are one frame apart, begin at rest and have a reference, the
    model closes its own loop. Otherwise, the logged commands drive the model: rows may have any
    times or be missing, and the record may begin in motion. A lost frame has empty measured
    columns. If a rule is broken, the error names the line or the frame.

    Writes result.json, which is also the JSON, and covariance.nc into the folder. From a record of
    your own it also writes scenario.toml, experiment.nc and model.nc; continue with cmmsim report,
    because validate needs the truth. Settings given here are stored in scenario.toml, so that
    validate, report and the next identify use them. result.json lists all settings of the
    estimator.

    \b
    Examples:
      cmmsim identify --out mine
      cmmsim identify --record mine.csv
      cmmsim identify --out mine --set identification.method=command_driven
      cmmsim identify --out mine --set identification.physical_consistency=true
      cmmsim identify --out mine \\
        --set 'identification.prior={"platform.mass"={value=23.5,std=0.1}}'
    """
    chosen = parse_settings(settings)
    progress = terminal_progress(quiet)
    if record:
        path = out or Path("runs") / record[0].stem
        folder = context.with_resource(new_run_folder(path))
        _pipeline().identify_own(record, folder.path, progress, chosen)
    elif out is None:
        raise typer.BadParameter(
            "name the folder of a run, or a record of your own with --record", param_hint="--out"
        )
    else:
        folder = RunFolder(out)
        # No trajectories were designed for a user's own record.
        folder.require(*(PLANNED[:1] if folder.holds_own_record else PLANNED))
        context.with_resource(lock_folder(out))
        _pipeline().identify(out, progress, chosen)
    result = _warned(folder)
    tell(result, json, quiet, lambda: _summary().print_identification(result, folder.result))


def validate(
    context: typer.Context,
    out: RunFolderOption,
    workers: Workers = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Validate the identified model on trajectories that were not used for it: the fourth stage.

    Reads scenario.toml, trajectories.json, experiment.nc, result.json and covariance.nc from the
    folder.

    Writes validation.nc and model.nc there, and completes result.json, which is also the JSON.

    \b
    Example:
      cmmsim validate --out mine
    """
    folder = RunFolder(out)
    if not folder.holds_own_record:
        folder.require(*PLANNED, "result.json")
    context.with_resource(lock_folder(out))
    _pipeline().validate(out, terminal_progress(quiet), workers)
    tell(load_result(folder.result), json, quiet, lambda: _wrote(folder.result, "report"))


def report(
    context: typer.Context,
    out: RunFolderOption,
    strict: Strict = False,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Draw the figures of a run and write its report, one file that opens without a network.

    A missed goal changes the exit status only with --strict.

    Reads result.json, covariance.nc, the records and model.nc from the folder. Writes report.html
    and figures there, and into result.json how long this took.

    \b
    Example:
      cmmsim report --out mine
    """
    folder = RunFolder(out)
    folder.require("result.json", "experiment.nc")
    context.with_resource(lock_folder(out))
    _pipeline().report(out, terminal_progress(quiet))
    result = load_result(folder.result)
    if not quiet:
        _summary().print_goals(result, folder.report)
    _tell_missed(result, quiet, strict)


def _tell_missed(result: dict[str, Any], unseen: bool, strict: bool) -> None:
    """Print missed goals on standard error if their table is unseen, and raise if strict."""
    from identify.reporting.goals import check_goals
    from identify.reporting.verdict import sentence

    goals = check_goals(result)
    missed = [goal for goal in goals if not goal.passed]
    if unseen:
        print_warnings(map(sentence, missed), "missed")
    if strict and missed:
        are = "is" if len(missed) == 1 else "are"
        names = ", ".join(goal.name for goal in missed)
        raise VerificationError(f"{len(missed)} of {len(goals)} goals {are} missed: {names}")


def _warned(folder: RunFolder) -> dict[str, Any]:
    """Load the result of a run, and print the notes and warnings of the identification."""
    result = load_result(folder.result)
    print_warnings(result["identification"].get("notes", []), "note")
    print_warnings(result["identification"].get("warnings", []))
    return result


def _summary() -> Any:
    """Import the summaries of a run late, for the same reason as the stages."""
    from identify.reporting import tables as run_summary

    return run_summary


def _pipeline() -> Any:
    """Import the stages late: ``cmmsim --help`` must not wait for CasADi and OpenGL."""
    with interruptible_imports():
        from identify import pipeline

    return pipeline
