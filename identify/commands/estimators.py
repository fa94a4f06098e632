"""The command ``cmmsim estimators``. Heavy imports are late."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from identify.files.run_folder import RunFolder, save_files
from identify.progress import print_table, terminal_progress

if TYPE_CHECKING:
    from identify.experiment.joint_instruments import JointInstruments
    from identify.validation.estimator_comparison import Score

HEADER = ("estimator", "groups\n%", "median\n%", "gains\n%", "pos.\num", "ori.\nurad", "time\ns", "iter.", "evals")


def estimators(
    out: Annotated[Path, typer.Option("--out", help="Folder of a whole run: cmmsim run.")],
    only: Annotated[
        list[str] | None,
        typer.Option(help="Name of an estimator, or module:function of one's own; repeatable.", show_default="all"),
    ] = None,
    add: Annotated[
        list[str] | None,
        typer.Option(help="Estimator of one's own beside these, as module:function; repeatable.", show_default="none"),
    ] = None,
    torque_noise: Annotated[float, typer.Option(min=0, help="Standard deviation of a measured torque, N m.")] = 0.02,
    encoder_noise: Annotated[float, typer.Option(min=0, help="Standard deviation of a joint angle, rad.")] = 1e-5,
    encoder_bits: Annotated[int, typer.Option(min=4, max=40, help="Bits a turn of the joint encoders.")] = 17,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the joint instruments' noise.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bars and no table.")] = False,
) -> None:
    """Compare estimators on the record of a run: writes instruments.nc, estimators.json and figures/estimators.png.

    The paper's output error beside its variants and beside what the literature does with measured joint torques and
    encoders (inverse dynamics; poses from the camera, or by forward kinematics). The run has no such instruments: they
    are simulated from its truth, with the noise given here. Where the PID is known it has the true gains. All are
    judged by the truth of the record and of the unseen trajectories. An estimator of one's own is a function of the
    evidence, see identify.estimators.estimator.
    """
    from identify.estimators.estimator import find_estimators
    from identify.experiment.joint_instruments import JointInstruments
    from identify.record.provenance import check_folder
    from identify.validation.estimator_comparison import estimators_figure

    folder = RunFolder(out)
    folder.require("scenario.toml", "experiment.nc", "validation.nc")
    check_folder(folder, "experiment.nc", "validation.nc")
    instruments = JointInstruments(torque_noise, encoder_noise, 2 * math.pi / 2**encoder_bits)
    chosen = find_estimators(only) | (find_estimators(add) if add else {})
    scores = _scores(folder, instruments, chosen, seed, quiet)
    entry = {"seed": seed, "instruments": asdict(instruments), "estimators": {s.name: _entry(s) for s in scores}}
    save_files(out, {"estimators.json": entry, "figures/estimators.png": estimators_figure(scores)})
    if not quiet:
        _print(scores, out)


def _scores(
    folder: RunFolder, instruments: "JointInstruments", chosen: dict[str, Any], seed: int, quiet: bool
) -> list["Score"]:
    import numpy as np

    from dynamics import load_robot
    from identify.estimation.identification import output_error_problem
    from identify.estimators.estimator import Evidence, joint_channels
    from identify.experiment.joint_instruments import measure_joints, read_channels, write_channels
    from identify.experiment.truth import read_truth, read_truth_runs, true_parameters
    from identify.loop_parameters import NAMES
    from identify.random_streams import INSTRUMENTS, LATENCY, mixed_generator, stream_seed
    from identify.record import recording
    from identify.scenario import load_scenario
    from identify.validation.estimator_comparison import compare, examination

    scenario = load_scenario(folder.scenario)
    record, truth = recording.read(folder.experiment), read_truth(folder.experiment)
    problem = output_error_problem([record], load_robot(scenario.robot), scenario)
    rng = mixed_generator(INSTRUMENTS, seed)
    channels = folder.path / "instruments.nc"
    draws = np.random.default_rng(stream_seed(int(record.attrs["seed"]), LATENCY, 0))
    latencies = scenario.timing.drawn_latencies(record.sizes["time"], draws)
    write_channels(channels, measure_joints(record, truth, scenario.timing, instruments, rng, latencies))
    known = true_parameters(truth)
    true = np.array([known[name] for name in NAMES])
    evidence = Evidence(problem, scenario, joint_channels(read_channels(channels), record), true[64:])
    unseen = zip(recording.read_runs(folder.validation), read_truth_runs(folder.validation), strict=True)
    asked = examination(evidence, true, list(unseen))
    return compare(evidence, asked, chosen, terminal_progress(quiet))


def _entry(score: "Score") -> dict[str, Any]:
    """A score with its parameters by name."""
    from identify.loop_parameters import NAMES

    entry = asdict(score)
    estimate, std = entry.pop("parameters"), entry.pop("std")
    if estimate is not None:
        entry["parameters"] = {
            name: {"estimate": estimate[k], "std": None if std is None else std[k]} for k, name in enumerate(NAMES)
        }
    return entry


def _print(scores: list["Score"], out: Path) -> None:
    print_table(
        HEADER,
        [(score.title, *_figures(score)) for score in scores],
        ("estimator",),
        "estimators on one record, against one truth",
        "groups: RMS and median relative error of the base parameters that the record shows; gains: RMS of "
        "those of the joint PID; position, orientation: model against true plant on unseen trajectories, RMS of the "
        "worst axis and run; evals: simulated runs of the model",
    )
    for score in scores:
        if score.note:
            typer.echo(f"{score.title}: {score.note}")
    typer.echo(f"files: {out}")


def _figures(score: "Score") -> list[str]:
    """A row of the table; a dash where there is nothing, such as the error of an unstable model."""
    gains = "given" if "gains" in score.uses else _short(100 * score.gain_distance)
    groups = [_short(100 * value) for value in (score.group_distance, score.group_median)]
    poses = [_short(value) for value in (score.position_um, score.orientation_urad, score.seconds)]
    return [*groups, gains, *poses, str(score.iterations), str(score.evaluations)]


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
