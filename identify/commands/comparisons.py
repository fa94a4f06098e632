"""Commands that compare estimators on one record, estimates of several runs, or excitations."""

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
from identify.files.lock import working_in
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
        list[str] | None, repeatable("Name of an estimator, or module:function of one's own", "all")
    ] = None,
    add: Annotated[
        list[str] | None,
        repeatable("Estimator of one's own beside these, as module:function", "none"),
    ] = None,
    torque_noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of a torque, N m, or of a force, N.",
            show_default="0.02, 0.5",
        ),
    ] = None,
    encoder_noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of a joint angle, rad, or length, m.",
            show_default="1e-5, 1e-6",
        ),
    ] = None,
    encoder_bits: Annotated[
        int | None,
        typer.Option(
            min=4,
            max=40,
            help="Bits a turn, or over the travel, of the encoders.",
            show_default="17, 1 um steps",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the joint instruments' noise.")] = 0,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Compare nine estimators, and your own, on the record of a run.

    The paper's output error beside its variants and beside what the literature does with measured
    joint torques and encoders (inverse dynamics; poses from the camera, or by forward kinematics).
    The run has no such instruments: they are simulated from its truth, with the noise given here.
    Where the joint controller is known it has the true gains. All are judged by the truth of the
    record and of the unseen trajectories. An estimator of one's own is a function of the evidence,
    see identify.estimators.estimator.

    Reads scenario.toml, experiment.nc and validation.nc of the folder.

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
    context.with_resource(working_in(folder.path))
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
    made = {
        "instruments.nc": netcdf({"": channels}),
        "estimators.json": entry,
        "figures/estimators.png": estimators_figure(scores),
    }
    save_files(folder.path, made)
    tell(entry, json, quiet, lambda: _print_scores(scores, out))


def _entry(score: "Score") -> dict[str, Any]:
    """Return a score as JSON has it, with its parameters by name."""
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
        "gains: RMS relative error of those of the joint controller; position, angle: model "
        "against true plant on unseen trajectories, RMS of the worst axis and run; runs: how often "
        "the model was simulated",
    )
    for score in scores:
        if score.note:
            typer.echo(f"{score.title}: {score.note}")
    typer.echo(f"files: {out}")


def _score_row(score: "Score") -> list[str]:
    """Return a row of the table, with a dash for what is not finite, as for an unstable model."""
    # An estimator that was given the true gains has no error of them.
    gains = "given" if "gains" in score.uses else _short(100 * score.gain_distance)
    groups = [_short(100 * value) for value in (score.group_distance, score.group_median)]
    poses = [_short(value) for value in (score.position_um, score.orientation_urad, score.seconds)]
    return [*groups, gains, *poses, str(score.iterations), str(score.evaluations)]


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    # From 999.5 on, three digits would be written with a power of ten.
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
            help="Record this many new runs, each on an exciting trajectory designed for it by the "
            "scenario's method, instead of taking the unseen runs.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=MOST_WORKERS,
            help="Processes that design and render.",
            show_default="one a core",
        ),
    ] = None,
    json: JsonFile = None,
    quiet: Quiet = False,
    plugin: Plugins = None,
) -> None:
    """Identify from each of several runs alone, and see how the estimates vary (the paper's table
    5).

    As in the paper, from the unseen runs of validation.nc; or from newly recorded ones, which are
    kept as variation.nc. The masses of the links vary most: only what accelerates shows them, so
    that fast trajectories tell more of them than long ones.

    Reads scenario.toml and validation.nc of the folder; with --designed trajectories.json in place
    of the latter.

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
    from identify.stages.repeat import designed_runs
    from identify.trajectory import load_trajectories
    from identify.validation.variation import identify_each
    from identify.validation.variation import variation as variation_of

    folder = RunFolder(out)
    progress = terminal_progress(quiet)
    folder.require("scenario.toml", "trajectories.json" if designed else "validation.nc")
    context.with_resource(working_in(folder.path))
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
    """Search with every method, and write comparison.json and comparison.png into `folder`."""
    from identify.excitation.comparison import compare_methods, comparison_figure
    from identify.excitation.information import knowledge
    from identify.record.known_geometry import KnownGeometry

    scenario = setup.scenario
    # The methods are compared on the robot of the file, which no run has to calibrate for it.
    setup = replace(setup, calibrated=KnownGeometry(setup.nominal))
    design = setup.design
    times = scenario.timing.frame_times(design.settings.duration_s)
    covariance = setup.sensor_plan.covariance(setup.robot.home_pose)
    known = knowledge(setup.side, scenario.identification, times, covariance)
    found = compare_methods(design, known, setup.seed, progress)
    figures = {**asdict(found), "scenario": scenario.name}
    figure = comparison_figure(design.robot, design.settings, found)
    save_files(folder, {"comparison.json": figures, "comparison.png": figure})
    paper = PAPER if scenario.robot == PAPERS_ROBOT else None
    tell(figures, json, quiet, lambda: _print_methods(found, folder, paper))


def _print_methods(found: "Comparison", folder: Path, note: str | None) -> None:
    """Print one row for each method, and its shares of the limits."""
    title = f"criterion {found.criterion}, seed {found.seed}, {found.candidates} random candidates"
    print_table(METHODS_HEADER, map(_method_row, found.entries), ("method", "stopped"), title, note)
    for entry in found.entries:
        nearest = sorted(entry.worst, key=lambda worst: -worst.share)
        used = ", ".join(f"{worst.name} {100 * worst.share:.2f} %" for worst in nearest)
        typer.echo(f"{entry.method}: share of each limit used: {used}")
    typer.echo(
        "maximised: the criterion (information: of the linearised loop). index: the paper's "
        "observability index, eq. 39. narrows: factor by which a run narrows what is known before "
        "of the parameters, with the simulated loop; - where that is unstable. Candidates and "
        f"functions took {found.preparation_seconds:.1f} s. Files: {folder}"
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
