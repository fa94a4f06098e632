"""The command ``cmmsim``: a whole run, or its stages one by one."""

import tomllib
import warnings
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from identify.commands import new_folder
from identify.commands.calibrate import CALIBRATE_HELP, calibrate
from identify.commands.check import CHECK_HELP, check
from identify.commands.comparisons import compare_excitation, estimators, variation
from identify.commands.geometry import GEOMETRY_HELP, geometry
from identify.commands.importing import imports
from identify.commands.robot import base_parameters, export, verify_model, workspace
from identify.commands.sensor import acceptance, detectors
from identify.commands.study import STUDY_HELP, study
from identify.errors import IdentifyError, ScenarioError
from identify.files.run_folder import RunFolder, load_result, new_run_folder
from identify.progress import print_warnings, terminal_progress
from identify.runtime import STOPPED, stoppable
from identify.scenario import Scenario, load_scenario, scenario_names

HELP = """
Identify a parallel robot from rendered stereo images, and prove how good the result is.

A simulated stereo camera measures the pose of a simulated robot, a visual servo moves it along an exciting
trajectory, and its dynamic parameters are estimated from the record. Unseen trajectories judge them.

\b
Examples:
  cmmsim warm-up                         compile robot and sensor now; no run waits for it later
  cmmsim run quick                       a one-minute run into runs/quick-0
  cmmsim run                             the paper's experiment into runs/paper-0
  cmmsim run paper --seed 7 --out mine   other noise and trajectories, into mine
  cmmsim run quick --robot ups6          another robot, built in or your own file
  cmmsim run quick --set timing.latency_s=0.0167 --set pose_method=planes

\b
A robot that the model cannot be, which the residuals tell:
  cmmsim run quick --set plant.geometry_error_m=1e-4         joints off by 0.1 mm
  cmmsim run quick --set plant.joint_stiffness_N_m_rad=1000  elastic joints

\b
The stages alone, each reading what the one before wrote:
  cmmsim excite quick --out mine         scenario.toml, trajectories.json
  cmmsim record --out mine               experiment.nc
  cmmsim identify --out mine             result.json
  cmmsim validate --out mine             validation.nc, model.nc, result.json
  cmmsim report --out mine               report.html, figures/*.png

\b
Another estimator on the same record, then judged and shown as before:
  cmmsim identify --out mine --set identification.method=command_driven
  cmmsim identify --out mine --set 'identification.prior={"platform.mass"={value=23.5,std=0.1}}'
  cmmsim identify --out mine --set identification.physical_consistency=true

\b
The model in other engines:
  cmmsim export mjcf rss6 --parameters mine/result.json --allow-unphysical-inertia
  cmmsim import mjcf model.xml --out mine.toml
  cmmsim verify-model                    MuJoCo against this model, figure8.png

\b
How well the stickers are found:
  cmmsim detectors                       detectors beside the Cramer-Rao bound

\b
The sensor alone, tested like a real instrument:
  cmmsim acceptance                      lengths, moving bar, latency: acceptance.md

\b
A real camera, or pictures to try it with:
  cmmsim calibrate --help                intrinsics, distortion and stereo from pictures of a board

\b
Which motion shows most:
  cmmsim excite paper --compare          random, evolutionary and gradient search side by side

\b
Where the robot can go:
  cmmsim check mine.toml                 what a designer wants to know of a robot
  cmmsim workspace rss6                  maps of travel, reach and conditioning

\b
Where its joints really are:
  cmmsim geometry                        calibrate the geometry by static poses: robot.toml

\b
What its motion can show:
  cmmsim base-parameters rss6            groups of parameters that no motion can separate

\b
Other estimators on the same record:
  cmmsim estimators --out mine           a table beside measured torques and encoders: estimators.json

\b
Other records of the same robot:
  cmmsim variation --out mine            how estimates vary from run to run (table 5): variation.md

\b
Many rows over a grid of settings, on all cores or many machines:
  cmmsim study --list                    the built-in studies
"""


class _Commands(TyperGroup):
    """Says when Ctrl-C has ended a command; typer alone would end it without a word."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("aborted", err=True)
            raise typer.Exit(STOPPED) from None


app = typer.Typer(
    name="cmmsim",
    cls=_Commands,
    help=HELP,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ScenarioArgument = Annotated[
    str, typer.Argument(help=f"Built-in scenario ({', '.join(scenario_names())}) or path of a TOML file.")
]
NewFolder = Annotated[Path | None, new_folder("runs/SCENARIO-SEED")]
RunFolderOption = Annotated[Path, typer.Option("--out", help="Folder of the run, as the stage before left it.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of all randomness: trajectories and sensor noise.")]
RobotOption = Annotated[
    str | None,
    typer.Option("--robot", metavar="NAME|FILE", help="Another robot than the scenario's.", show_default="scenario's"),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a value of the scenario: timing.frame_rate_hz=30."),
]
EstimatorSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a setting of the estimator, in the sections identification, model or filter of the scenario: "
        "identification.method=command_driven. The record was made with the rest.",
    ),
]
Workers = Annotated[
    int | None, typer.Option("--workers", min=1, help="Processes that render.", show_default="one a core")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars and no summary; warnings stay.")]


def main() -> None:
    """Run the command; a known error is one line on standard error and exit status 1."""
    warnings.showwarning = _show_warning
    try:
        app()
    except Exception as error:
        if not is_known(error):
            raise
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise SystemExit(1) from None


def _show_warning(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    """A warning as one line, without the place in the code that gave it."""
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


def is_known(error: Exception) -> bool:
    """Whether an error is one that a user can cause or meet, of any of the three packages."""
    if isinstance(error, IdentifyError) or (isinstance(error, OSError) and error.filename is not None):
        return True
    from cmmsim.errors import CmmError, OpenGLMissingError
    from dynamics.errors import DynamicsError

    return isinstance(error, (CmmError, OpenGLMissingError, DynamicsError))


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cmmsim {metadata.version('cmmsim')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def run(
    scenario: ScenarioArgument = "paper",
    out: NewFolder = None,
    seed: Seed = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """Do the whole experiment: excite, record, identify, validate, report.

    A goal that is missed is said, and does not change the exit status.
    """
    chosen = _scenario(scenario, settings, robot)
    folder = new_run_folder(out or Path("runs") / f"{chosen.name}-{seed}")
    _pipeline().run(chosen, seed, folder.path, terminal_progress(quiet), workers)
    result = _warned(folder)
    if not quiet:
        _summary().print_goals(result, folder.report)


@app.command()
def warm_up(
    scenario: ScenarioArgument = "paper",
    robot: RobotOption = None,
    settings: Settings = None,
    all_robots: Annotated[bool, typer.Option("--all-robots", help="Compile every built-in robot, too.")] = False,
    quiet: Quiet = False,
) -> None:
    """Compile all that runs of a scenario need, once for this user: the runs that follow compile nothing.

    A robot is compiled for itself, and one with another number of joints or freedoms compiles the loop anew.
    """
    from dynamics import built_in_robots, load_robot
    from identify.experiment.run import warm_up

    others = tuple(load_robot(name) for name in built_in_robots()) if all_robots else ()
    warm_up(_scenario(scenario, settings, robot), terminal_progress(quiet), others)


@app.command()
def excite(
    scenario: ScenarioArgument = "paper",
    out: NewFolder = None,
    seed: Seed = 0,
    robot: RobotOption = None,
    settings: Settings = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Only compare the methods: writes comparison.json and comparison.png.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Choose the exciting trajectory and the unseen ones: writes scenario.toml and trajectories.json."""
    chosen = _scenario(scenario, settings, robot)
    name = f"excite-{chosen.name}-{seed}" if compare else f"{chosen.name}-{seed}"
    folder = new_run_folder(out or Path("runs") / name)
    if compare:
        compare_excitation(chosen, seed, folder.path, terminal_progress(quiet), quiet)
        return
    _pipeline().excite(chosen, seed, folder.path, terminal_progress(quiet))


@app.command()
def record(out: RunFolderOption, workers: Workers = None, quiet: Quiet = False) -> None:
    """Run the plant with images in the loop on the exciting trajectory: writes experiment.nc."""
    RunFolder(out).require("scenario.toml", "trajectories.json")
    _pipeline().record(out, terminal_progress(quiet), workers)


@app.command()
def identify(out: RunFolderOption, settings: EstimatorSettings = None, quiet: Quiet = False) -> None:
    """Estimate the parameters from the record: writes result.json.

    What is set here stays in scenario.toml, so that validate, report and the next identify go on with it; result.json
    lists all settings of its estimator.
    """
    folder = RunFolder(out)
    folder.require("scenario.toml", "trajectories.json", "experiment.nc")
    _pipeline().identify(out, terminal_progress(quiet), parse_settings(settings))
    result = _warned(folder)
    if not quiet:
        _summary().print_identification(result, folder.result)


@app.command()
def validate(out: RunFolderOption, workers: Workers = None, quiet: Quiet = False) -> None:
    """Judge the identified model on unseen trajectories: writes validation.nc and completes result.json."""
    RunFolder(out).require("scenario.toml", "trajectories.json", "experiment.nc", "result.json")
    _pipeline().validate(out, terminal_progress(quiet), workers)


@app.command()
def report(out: RunFolderOption, quiet: Quiet = False) -> None:
    """Draw the figures and write report.html, one file that opens offline."""
    folder = RunFolder(out)
    folder.require("result.json", "experiment.nc", "validation.nc", "model.nc")
    _pipeline().report(out, terminal_progress(quiet))
    if not quiet:
        _summary().print_goals(load_result(folder.result), folder.report)


app.command("verify-model")(verify_model)
app.add_typer(export, name="export")
app.add_typer(imports, name="import")
app.command()(detectors)
app.command(help=CHECK_HELP)(check)
app.command()(workspace)
app.command(help=CALIBRATE_HELP)(calibrate)
app.command(help=GEOMETRY_HELP)(geometry)
app.command()(acceptance)
app.command()(base_parameters)
app.command()(estimators)
app.command()(variation)
app.command(help=STUDY_HELP)(stoppable(study))


def parse_settings(settings: list[str] | None) -> dict[str, Any]:
    """Overrides from ``KEY=VALUE`` texts; a value is TOML, and what is no TOML is a string.

    Raises ScenarioError: a text without ``=``.
    """
    overrides = {}
    for text in settings or []:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ScenarioError(f"--set {text!r} is not of the form KEY=VALUE, such as timing.frame_rate_hz=30")
        overrides[key.strip()] = _toml_or_text(value.strip())
    return overrides


def _toml_or_text(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _scenario(name: str, settings: list[str] | None, robot: str | None) -> Scenario:
    chosen = {} if robot is None else {"robot": robot}
    return load_scenario(name).with_overrides(chosen | parse_settings(settings))


def _warned(folder: RunFolder) -> dict[str, Any]:
    """The result of a run; says what its identification warns of."""
    result = load_result(folder.result)
    print_warnings(result["identification"].get("warnings", []))
    return result


def _summary() -> Any:
    """What a run says of itself, imported late as the stages are."""
    from identify.reporting import tables as run_summary

    return run_summary


def _pipeline() -> Any:
    """The stages, imported late: ``cmmsim --help`` must not wait for CasADi and OpenGL."""
    from identify import pipeline

    return pipeline
