"""Commands that compare estimators, estimates from several runs, or methods of excitation."""

import math
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.commands.options import (
    MOST_WORKERS,
    JsonFile,
    Plugins,
    Quiet,
    WholeRunOption,
    allow_named,
    repeatable,
    tell,
)
from identify.files.lock import lock_folder
from identify.files.run_folder import RunFolder, save_files
from identify.progress import Progress, print_table, terminal_progress
from identify.scenario import load_scenario

if TYPE_CHECKING:
    from identify.excitation.comparison import Comparison, Entry
    from identify.setup import Setup
    from identify.validation.estimator_comparison import Score

ESTIMATORS_HEADER = (
    "estimator",
    "groups\n%",
    "median\n%",
    "gains\n%",
    "position\nµm",
    "angle\nµrad",
    "time\ns",
    "iterations",
    "runs",
)

METHODS_HEADER = (
    "method",
    "maximised",
    "index",
    "narrows",
    "seconds",
    "values",
    "gradients",
    "stopped",
)

PAPERS_ROBOT = "rss6"
PAPER = (
    "the paper, with its own robot and geometry: index 0.38 at the start, 1.345 after 324 "
    "generations"
)


def estimators(
    context: typer.Context,
    out: WholeRunOption,
    only: Annotated[
        list[str] | None, repeatable("Name of an estimator, or module:function of your own", "all")
    ] = None,
    add: Annotated[
        list[str] | None,
        repeatable("Additional estimator of your own, as module:function", "none"),
    ] = None,
    torque_noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of measured torques, N m, or forces, N.",
            show_default="0.02, 0.5",
        ),
    ] = None,
    encoder_noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of measured joint angles, rad, or lengths, m.",
            show_default="1e-5, 1e-6",
        ),
    ] = None,
    encoder_bits: Annotated[
        int | None,
        typer.Option(
            min=4,
            max=40,
            help="Bits of an encoder per turn, or over the travel of a linear joint.",
            show_default="17; linear: 1 um steps",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the joint instruments' noise.")] = 0,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Compare ten estimators, and your own, on the record of a run.

    The estimators are the paper's output error, its variants, and estimators of the literature
    that use measured joint torques and encoders (inverse dynamics, with poses from the camera or
    from forward kinematics). These instruments are simulated from the truth of the run, with the
    noise given here. An estimator that knows the joint controller gets its true gains. All are
    compared with the truth of the record and of the validation trajectories. An estimator of your
    own is a function of the evidence; see identify.estimators.estimator.

    Reads scenario.toml, experiment.nc and validation.nc from the folder.

    Writes instruments.nc, estimators.json, which is also the JSON, and figures/estimators.png
    there.

    \b
    Examples:
      cmmsim estimators --out runs/paper-0
      cmmsim estimators --out mine --only closed_loop --only torque_wls
      cmmsim estimators --out mine --add my_module:my_estimator
    """
    from dynamics import load_robot
    from identify.estimators.estimator import find_estimators
    from identify.experiment.joint_instruments import instruments_of
    from identify.files.dataset import netcdf
    from identify.record.provenance import RunFiles
    from identify.validation.estimator_comparison import compare_on_run, estimators_figure

    folder = RunFolder(out)
    folder.require("scenario.toml", "experiment.nc", "validation.nc")
    context.with_resource(lock_folder(folder.path))
    files = RunFiles(folder)
    files.check_made_of("experiment.nc", "validation.nc")
    allow_named([*(only or ()), *(add or ())])
    robot = load_robot(load_scenario(folder.whole_scenario).robot)
    instruments = instruments_of(robot, torque_noise, encoder_noise, encoder_bits)
    chosen = find_estimators(only) | (find_estimators(add) if add else {})
    scores, channels = compare_on_run(files, instruments, chosen, seed, terminal_progress(quiet))
    entry = {
        "seed": seed,
        "instruments": instruments.figures,
        "estimators": {s.name: _entry(s) for s in scores},
    }
    contents = {
        "instruments.nc": netcdf({"": channels}),
        "estimators.json": entry,
        "figures/estimators.png": estimators_figure(scores),
    }
    save_files(folder.path, contents)
    tell(entry, json, quiet, lambda: _print_scores(scores, out))


def _entry(score: "Score") -> dict[str, Any]:
    """Return a score as a JSON entry, with its parameters by name."""
    entry = asdict(score)
    estimate = entry.pop("parameters")
    std = entry.pop("std")
    names = entry.pop("names")
    if estimate is not None:
        entry["parameters"] = {
            name: {"estimate": estimate[k], "std": None if std is None else std[k]}
            for k, name in enumerate(names)
        }
    return entry


def _print_scores(scores: list["Score"], out: Path) -> None:
    print_table(
        ESTIMATORS_HEADER,
        [(score.title, *_score_row(score)) for score in scores],
        ("estimator",),
        "estimators on one record, against one truth",
        "groups: RMS and median relative error of the base parameters that the record shows; "
        "gains: RMS relative error of the gains of the joint controller; position, angle: RMS "
        "difference of model and true plant on the validation trajectories, of the worst axis and "
        "run; runs: number of simulations of the model",
    )
    for score in scores:
        if score.note:
            typer.echo(f"{score.title}: {score.note}")
    typer.echo(f"files: {out}")


def _score_row(score: "Score") -> list[str]:
    """Return a row of the table. A value that is not finite, as of an unstable model, is a dash."""
    # An estimator that was given the true gains has no error in them.
    gains = "given" if "gains" in score.uses else _short(100 * score.gain_distance)
    groups = [_short(100 * value) for value in (score.group_distance, score.group_median)]
    poses = [_short(value) for value in (score.position_um, score.orientation_urad, score.seconds)]
    return [*groups, gains, *poses, str(score.iterations), str(score.evaluations)]


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    # From 999.5 on, the format g with three digits would write a power of ten.
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def variation(
    context: typer.Context,
    out: WholeRunOption,
    designed: Annotated[
        int | None,
        typer.Option(
            "--designed",
            min=3,
            metavar="COUNT",
            help="Number of new runs to record in place of the validation runs. The scenario's "
            "method designs an exciting trajectory for each.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=MOST_WORKERS,
            help="Number of processes that design and render.",
            show_default="one per core",
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Identify from each of several runs separately, and print the scatter of the estimates (the
    paper's table 5).

    The runs are the validation runs of validation.nc, as in the paper, or newly recorded runs,
    which are stored as variation.nc. The masses of the links vary most. Only accelerations separate
    these from the other parameters, so fast trajectories determine them better than long ones.

    Reads scenario.toml and validation.nc from the folder; with --designed, trajectories.json in
    place of validation.nc.

    Writes variation.json, which is also the JSON, variation.md and figures/variation.png there.

    \b
    Examples:
      cmmsim variation --out runs/paper-0
      cmmsim excite paper --set excitation.fundamental_hz=0.3 --out fast
      cmmsim variation --out fast --designed 10
    """
    from dynamics import load_robot
    from identify.estimation.identification import identify
    from identify.files.dataset import netcdf
    from identify.record.provenance import RunFiles
    from identify.record.recording import run_groups
    from identify.reporting import variation_tables as tables
    from identify.setup import Setup
    from identify.stages.validate import designed_runs
    from identify.trajectory import load_trajectories
    from identify.validation.variation import identify_each
    from identify.validation.variation import variation as variation_of

    folder = RunFolder(out)
    progress = terminal_progress(quiet)
    folder.require("scenario.toml", "trajectories.json" if designed else "validation.nc")
    context.with_resource(lock_folder(folder.path))
    scenario = load_scenario(folder.whole_scenario)
    robot = load_robot(scenario.robot)
    recorded: dict[str, bytes] = {}
    if designed:
        seed = load_trajectories(folder.trajectories).seed
        runs = designed_runs(Setup(scenario, seed), designed, workers, progress)
        groups = run_groups([(run.record, run.truth) for run in runs])
        recorded = {"variation.nc": netcdf(groups)}
        records = [run.record for run in runs]
        origin = f"designed: {scenario.excitation.method}"
    else:
        seen = RunFiles(folder)
        seen.check_made_of("validation.nc")
        records = seen.validation
        origin = "unseen"
    identify_one = partial(identify, robot=robot, scenario=scenario)
    found = variation_of(identify_each(records, identify_one, progress))
    table = tables.variation_table(found)
    entry = tables.variation_entry(found, origin)
    files = {
        **recorded,
        "variation.json": entry,
        "variation.md": f"# {table.title}\n\n{table.markdown()}\n\n{table.note}\n",
        "figures/variation.png": tables.variation_figure(found),
    }
    save_files(out, files)

    def say() -> None:
        name, worst = found.worst
        print_table(table.header, table.rows, ("parameter", "unit"), table.title, table.note)
        typer.echo(f"largest: {100 * worst:.3g} % of {name}; files: {out}")

    tell(entry, json, quiet, say)


def compare_excitation(
    setup: "Setup", folder: Path, progress: Progress, json: Path | None, quiet: bool
) -> None:
    """Run every search method, write comparison.json and comparison.png, and output the results."""
    from identify.excitation.comparison import compare_methods, comparison_figure
    from identify.excitation.information import knowledge
    from identify.record.known_geometry import KnownGeometry

    scenario = setup.scenario
    # The comparison uses the geometry of the robot file, so no calibration is needed.
    setup = replace(setup, calibrated=KnownGeometry(setup.nominal))
    design = setup.design
    times = scenario.timing.frame_times(design.settings.duration_s)
    covariance = setup.sensor_plan.covariance(setup.robot.home_pose)
    known = knowledge(setup.side, scenario.identification, times, covariance)
    found = compare_methods(design, known, setup.seed, progress)
    entry = {**asdict(found), "scenario": scenario.name}
    figure = comparison_figure(design.robot, design.settings, found)
    save_files(folder, {"comparison.json": entry, "comparison.png": figure})
    paper = PAPER if scenario.robot == PAPERS_ROBOT else None
    tell(entry, json, quiet, lambda: _print_methods(found, folder, paper))


def _print_methods(found: "Comparison", folder: Path, note: str | None) -> None:
    """Print one row per method, and how much of each limit its trajectory uses."""
    title = f"criterion {found.criterion}, seed {found.seed}, {found.candidates} random candidates"
    print_table(METHODS_HEADER, map(_method_row, found.entries), ("method", "stopped"), title, note)
    for entry in found.entries:
        nearest = sorted(entry.worst, key=lambda worst: -worst.share)
        used = ", ".join(f"{worst.name} {100 * worst.share:.2f} %" for worst in nearest)
        typer.echo(f"{entry.method}: share of each limit used: {used}")
    typer.echo(
        "maximised: the criterion (if information, of the linearised loop). index: the paper's "
        "observability index, eq. 39. narrows: factor by which a run reduces the prior uncertainty "
        "of the parameters, with the simulated loop; - if that loop is unstable. Candidates and "
        f"functions were prepared in {found.preparation_seconds:.1f} s. Files: {folder}"
    )


def _method_row(entry: "Entry") -> tuple[str, ...]:
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
