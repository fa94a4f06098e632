"""Comparison of laws and models on the same motions.

The results are the tracking error, the effort, and the fractions of the squared error by cause.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cmmsim
from dynamics.closed_loop import LoopFailure
from dynamics.control.inverse_dynamics import FITTED_DOUBT, GUESSED_DOUBT
from dynamics.errors import DynamicsError
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.estimation.explanation import MISFIT, Misfit
from identify.estimation.identification import identify
from identify.estimation.prior import starting_guess
from identify.estimation.result import IdentificationResult
from identify.excitation.design import design_trajectories
from identify.experiment.law_in_loop import KnownModel, LoopSensor, NamedMotion, by_images, prepared
from identify.experiment.plant import Plant
from identify.experiment.run import Latencies, delay_right_camera, drawn_latencies, excitation_run
from identify.experiment.sensor_in_loop import PoseSensor, SensorInLoop, teach
from identify.files.run_folder import RunFolder, load_result, rms_figures
from identify.files.versions import versions
from identify.loop_parameters import parameter_column, settled_drive
from identify.progress import Advance, Progress
from identify.random_streams import NOISE, TRACKED, child, stream_seed
from identify.record.conditions import SERVO
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.tracking.following import TrackingRun, by_drawing, follow
from identify.tracking.motions import motions

# Names of the models: the scenario's initial guess, the identified model, and the true plant.
MODELS = ("initial", "identified", "true")
# Number of the first run. The runs of an identification have smaller numbers, so the random streams
# are separate.
FIRST_RUN = 2_000_000
# Parts that are made exact, one at a time, to determine their fraction of the squared error.
EXACT = ("sensor", "model", "latency")

PARTS = ("position", "orientation")


@dataclass(frozen=True)
class Tracking:
    """Task of a comparison: all laws with all models, by name, on all motions."""

    plant: Plant
    sensor: cmmsim.Sensor
    motions: Sequence[NamedMotion]
    models: dict[str, KnownModel]
    laws: Sequence[str]
    seed: int


def track(
    setup: Setup,
    laws: Sequence[str],
    models: Sequence[str],
    progress: Progress,
    run_folder: Path | None = None,
    own: Path | None = None,
) -> dict[str, Any]:
    """Return the content of track.json.

    run_folder  Folder of a finished run. Its estimates are the identified model. With None, the
                robot is identified first, if that model is requested.
    own         CSV file with poses to follow in place of the standard motions.

    Raises ScenarioError, TrajectoryError, OutputFolderError or RecordError if scenario, motion or
    run folder does not fit. Errors of the identification are also raised.
    """
    scenario = setup.scenario
    seed = setup.seed
    plant = setup.plant
    followed = motions(setup.design, seed, own)
    if run_folder and "identified" not in models:
        raise ScenarioError(
            f"--run {run_folder} gives the identified model, but only {', '.join(models)} is "
            "requested"
        )
    if set(laws) == {"pid"}:
        # This law uses no model, so no model has to be identified.
        models = ["initial"]
    known = {name: known_model(plant, name) for name in models if name != "identified"}
    if run_folder and "identified" in models:
        known["identified"] = model_of_run(plant, run_folder, scenario.robot)
    unseen = LoopSensor(lambda frame, t, pose, rate: pose, lambda frame: np.eye(6))
    # Of these checks, only that of the gains of computed_torque depends on the model. They precede
    # the teaching of the sensor, because teaching takes long.
    true = known_model(plant, "true")
    for law in laws:
        for motion in followed:
            prepared(plant, law, true, motion, unseen)
    teach(setup.sensor, progress)
    if "identified" in models and not run_folder:
        known["identified"] = _identified(setup, progress)
    named = {name: known[name] for name in models}
    task = Tracking(plant, setup.sensor, followed, named, laws, seed)
    return {
        "scenario": scenario.name,
        "seed": seed,
        "robot": plant.nominal.name,
        "versions": versions(),
        "frame_rate_hz": scenario.timing.frame_rate_hz,
        "latency_s": scenario.timing.latency_s,
        "effort_unit": plant.nominal.layout.unit("joint1.coulomb"),
        "motions": [motion.name for motion in followed],
        "runs": _runs(task, progress),
    }


def known_model(plant: Plant, model: str) -> KnownModel:
    """Return the model of a plant with the name "initial" or "true"."""
    if model == "true":
        known = plant.parameters_of(plant.nominal.layout)
        return KnownModel(known, plant.switches.drive, FITTED_DOUBT)
    start = plant.loop.side.model
    law = start.drive_law
    guess = starting_guess(plant.nominal, start.start_parameters, 1.0, drive=law)
    return KnownModel(guess.values, law)


def model_of_run(plant: Plant, run_folder: Path, own: str) -> KnownModel:
    """Return the model that was identified in a run folder.

    ``own`` is the name or the file of the plant's robot. Raises OutputFolderError if the folder
    lacks scenario or result, and RecordError if the result has no estimates or is of another robot.
    """
    path = run_folder / "result.json"
    RunFolder(run_folder).require("scenario.toml", "result.json")
    other = load_scenario(RunFolder(run_folder).whole_scenario).robot
    if other != own:
        raise RecordError(f"{run_folder} contains a run of {other}, not of {own}")
    try:
        identification = load_result(path).get("identification")
        names = plant.nominal.layout.names
        column = parameter_column(identification, "estimate", names)
        numbers: list[Any] = [(identification or {}).get(name) for name in MISFIT]
        misfit = None if None in numbers else Misfit(*numbers)
        return KnownModel(np.array(column), settled_drive(identification), _fitted_doubt(misfit))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


def _identified(setup: Setup, progress: Progress) -> KnownModel:
    """Identify the model from the scenario's excitation."""
    settings = setup.scenario.excitation
    if setup.scenario.identification.scale_anchor == "payload":
        raise ScenarioError(
            "identification.scale_anchor = payload needs two runs: identify first, and pass --run "
            "DIR"
        )
    trajectory = design_trajectories(setup.design, setup.seed, progress).excitation
    with progress.stage("record", setup.sensor_plan.frames) as advance:
        record = excitation_run(
            setup.plant, setup.sensor, trajectory, settings, setup.seed, advance
        ).record
    return model_of_result(identify(record, setup.robot, setup.scenario, progress))


def model_of_result(found: IdentificationResult) -> KnownModel:
    """Return the model that was identified from a record."""
    return KnownModel(found.estimate, found.drive.law, _fitted_doubt(found.misfit))


def _fitted_doubt(misfit: Misfit | None) -> float:
    """Return `KnownModel.doubt` of an identified model.

    A model that does not explain its record is doubted like a guess.
    """
    return GUESSED_DOUBT if misfit is None or misfit.significant else FITTED_DOUBT


def follow_by_images(
    plant: Plant,
    sensor: PoseSensor,
    law: str,
    model: KnownModel,
    motion: NamedMotion,
    seed: int,
    number: int = 0,
    advance: Advance = lambda n=1: None,
) -> tuple[TrackingRun, LoopSensor]:
    """Follow a motion under a law with a model, with images in the loop.

    Noise and latencies depend on the seed and on the motion's number. The mean latency and the
    delay between the exposures depend only on the seed. The second returned value is the
    measurement in the loop. Raises the errors of `follow`.
    """
    delay_right_camera(sensor, plant.runs.rig, seed)
    seen = by_images(
        SensorInLoop(sensor, plant.robot, stream_seed(seed, NOISE, FIRST_RUN + number), advance)
    )
    latencies = _latencies(plant, motion, seed, number)
    return follow(plant, law, model, motion, seen, latencies), seen


def _runs(task: Tracking, progress: Progress) -> list[dict[str, Any]]:
    timing = task.plant.runs.timing
    frames = sum(timing.frames(motion.duration_s) for motion in task.motions)
    runs = [
        (law, model) for law in task.laws for model in ([None] if law == SERVO else task.models)
    ]
    with progress.stage("track", frames * len(runs) * (2 + len(EXACT))) as advance:
        return [
            {"law": law, "model": model} | _entry(task, law, model, advance) for law, model in runs
        ]


def _entry(task: Tracking, law: str, model: str | None, advance: Advance) -> dict[str, Any]:
    """Return the entry of one law with one model on all motions.

    The model is None for a law that uses no model.
    """
    robot = task.plant.robot
    known = task.models[model or next(iter(task.models))]
    errors = []
    rows = []
    effort = []
    normalised = []
    covariances = []
    frames = 0
    saturated = 0
    lost = 0
    for number, motion in enumerate(task.motions):
        try:
            done, seen = follow_by_images(
                task.plant, task.sensor, law, known, motion, task.seed, number, advance
            )
        except DynamicsError as error:
            if isinstance(error, LoopFailure):
                frames += error.frame
                saturated += error.saturated
            # A failed run has figures up to the frame of its failure, and no errors.
            failure = {
                "failed": f"{motion.name}: {error}",
                "frames": frames,
                "saturated_frames": saturated,
            }
            return failure | rms_figures(np.full((1, 6), np.nan))
        frames += len(done.errors)
        saturated += done.saturated
        errors.append(done.errors)
        lost += int((~done.run.measured_ok).sum())
        effort.append(done.run.torque)
        covariances += [seen.noise(int(frame)) for frame in np.flatnonzero(done.run.measured_ok)]
        error_ratio = done.normalised_squared_error(robot)
        normalised += [] if error_ratio is None else [error_ratio]
        rows.append(
            {"motion": motion.name, **rms_figures(done.errors), "saturated_frames": done.saturated}
        )
    torque = np.concatenate(effort)
    return {
        **rms_figures(np.concatenate(errors)),
        "effort_rms": float(np.sqrt(np.mean(torque**2))),
        "effort_largest": float(np.abs(torque).max()),
        "frames": frames,
        "saturated_frames": saturated,
        "lost_frames": lost,
        "observer_normalised_error": float(np.mean(normalised)) if normalised else None,
        "shares": _shares(task, law, known, np.mean(covariances, axis=0), advance),
        "motions": rows,
    }


def _shares(
    task: Tracking, law: str, known: KnownModel, covariance: Array, advance: Advance
) -> dict[str, Any]:
    """Return the fractions of the squared error by cause, for position and orientation.

    A cause's fraction disappears with an exact sensor, with an exact model, or without latency and
    dropout. The rest completes the sum to one. The measured poses of these runs are drawn with the
    noise that the sensor stated.
    """
    base = _drawn(task, law, known, covariance, None, advance)
    fractions = {}
    for what in EXACT:
        exact = _drawn(task, law, known, covariance, what, advance)
        # A component without motion has no error, and a failed run has NaN.
        with np.errstate(invalid="ignore", divide="ignore"):
            remaining = [
                exact[part].sum() / base[part].sum() for part in (slice(0, 3), slice(3, 6))
            ]
        fractions[what] = dict(zip(PARTS, (1 - np.array(remaining)).tolist(), strict=True))
    rest = {part: 1 - sum(fraction[part] for fraction in fractions.values()) for part in PARTS}
    return fractions | {"rest": rest}


def _drawn(
    task: Tracking,
    law: str,
    model: KnownModel,
    covariance: Array,
    exact: str | None,
    advance: Advance,
) -> Array:
    """Return the mean squared errors (6,) over all motions with one part exact.

    They are NaN if a run fails.
    """
    plant = task.plant
    if exact == "latency":
        plant = plant.without_latency()
    timing = plant.runs.timing
    squares = []
    for number, motion in enumerate(task.motions):
        # The runs for all causes have the same noise, so that it cancels in their differences.
        rng = np.random.default_rng(child(task.seed, TRACKED, number))
        lost = rng.random(timing.frames(motion.duration_s)) < timing.dropout
        seen = by_drawing(covariance, lost, rng, exact == "sensor")
        known = known_model(plant, "true") if exact == "model" else model
        latencies = (
            Latencies() if exact == "latency" else _latencies(task.plant, motion, task.seed, number)
        )
        try:
            done = follow(plant, law, known, motion, seen, latencies)
            squares.append(done.errors**2)
            advance(len(lost))
        except DynamicsError:
            return np.full(6, np.nan)
    return np.asarray(np.concatenate(squares).mean(axis=0))


def _latencies(plant: Plant, motion: NamedMotion, seed: int, number: int) -> Latencies:
    timing = plant.runs.timing
    return drawn_latencies(timing, timing.frames(motion.duration_s), seed, FIRST_RUN + number)
