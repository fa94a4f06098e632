"""Rows of kind `calibration_of_intervals`: simulation-based calibration of an identification.

The true parameters of each row are drawn from the prior that the estimator states, and the exciting
trajectory and the noise are drawn anew. The row holds the probability that the estimator's stated
distribution gives to values below the truth. If the stated distributions are right, these
probabilities are uniform between 0 and 1 over the rows, whatever the truth (Talts et al. 2018,
"Validating Bayesian inference algorithms with simulation-based calibration").

A truth is drawn again if one of its bodies cannot exist, if a parameter is below its bound, or if
its loop is unstable. The row counts these draws.
"""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import ndtr

from dynamics import Robot
from dynamics.closed_loop import LoopFailure
from identify.arrays import Array
from identify.errors import StudyError
from identify.estimation.bounds import ParameterBounds, parameter_bounds
from identify.estimation.identifiability import group_rows
from identify.estimation.identification import identify as identify_record
from identify.estimation.prior import StartingGuess, model_guess
from identify.estimation.result import IdentificationResult
from identify.estimation.scale_anchor import read_anchor, store_anchor
from identify.excitation.design import admissible_trajectories
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment, run_plant
from identify.experiment.sensor_in_loop import PoseSensor
from identify.experiment.truth import true_poses
from identify.files.dataset import POSE
from identify.progress import SilentProgress
from identify.random_streams import child, stream_seed
from identify.record.conditions import COMMAND_TIME
from identify.record.recording import poses as recorded_poses
from identify.record.stored_common_errors import CHANGES
from identify.record.timed_record import build_timed_record
from identify.scenario import Scenario
from identify.setup import Setup
from identify.studies.rows.coverage import intervals_hold
from identify.studies.rows.identified import (
    EXPERIMENT,
    READS,
    memory,
    row_setup,
)
from identify.studies.rows.kind import PROBABILITY, Column, KeysRead, Kind, Row
from identify.studies.rows.row_sensor import SensorOptions, row_pose_sensor
from identify.validation.pose_prediction import PosePrediction, predicted_runs

# Children of the seed of a row, in addition to `identified.EXPERIMENT`.
TRUTH = 1
TRAJECTORIES = 2
FRAME = 3
AT_REST = 1e-9  # largest change of a pose, m or rad, while the platform rests
MOST_TRUTHS = 50  # largest number of truths that are drawn for a row
INNER = 0.683  # probability of the shorter intervals, one standard deviation to both sides

COLUMNS = {
    "intervals": Column(
        "1", "quantities that the record identifies: parameters, and groups of several"
    ),
    "covered_percent": Column(
        "%", "fraction of their 95 % intervals that contain the truth", main=True
    ),
    "inner_covered_percent": Column(
        "%", "fraction of their 68.3 % intervals that contain the truth", main=True
    ),
    "poses_covered_percent": Column(
        "%",
        "fraction of the true coordinates of an unseen pose in the predicted 95 % intervals",
        main=True,
    ),
    "poses_inner_covered_percent": Column("%", "the same for predicted 68.3 % intervals"),
    "noise_ratio": Column(
        "1", "mean squared residual over the variance of the noise; 1 if only noise remains"
    ),
    "redrawn_truths": Column("1", "truths that were drawn again because their loop is unstable"),
    "redrawn_values": Column(
        "1", "numbers of the truth that were drawn again because no body or drive can have them"
    ),
}


class CalibrationOptions(SensorOptions):
    """Options of rows of kind `calibration_of_intervals`."""

    log_from_s: float = Field(
        0.0,
        ge=0.0,
        description="time at which the log begins; above 0 the robot moves already, so that the "
        "logged commands drive the model and its state at the start is estimated",
    )


@dataclass(frozen=True)
class DrawnTruth:
    """True parameters (p,), and the number of values drawn again because they were impossible."""

    values: Array
    redrawn: int


def drawn_truth(
    guess: StartingGuess, bounds: ParameterBounds, rng: np.random.Generator
) -> DrawnTruth:
    """Draw true parameters from an estimator's prior within its bounds.

    Single parameters, and all parameters of a body together, are drawn again until they are within
    the bounds. The result has the distribution of the prior truncated at the bounds.
    """
    values = guess.values.copy()
    missing = np.ones(len(values), dtype=bool)
    redrawn = -len(values)
    while missing.any():
        redrawn += int(missing.sum())
        drawn = guess.values + guess.std * rng.standard_normal(len(values))
        values[missing] = drawn[missing]
        missing = bounds.outside(values)
    return DrawnTruth(values, redrawn)


@dataclass(frozen=True)
class StableExperiments:
    """Runs of a plant with a drawn truth.

    plant     Plant with the truth.
    record    Run of the exciting trajectory.
    unseen    Run of another trajectory.
    unstable  Number of truths drawn earlier, whose loop is unstable.
    redrawn   Number of values, in all truths, that were drawn again because they were impossible.
    """

    plant: Plant
    record: Experiment
    unseen: Experiment
    unstable: int
    redrawn: int


def stable_experiments(
    setup: Setup,
    sensor: PoseSensor,
    guess: StartingGuess,
    bounds: ParameterBounds,
    seed: np.random.SeedSequence,
) -> StableExperiments:
    """Draw a truth and random trajectories until the loop is stable, and return the runs.

    Raises StudyError if none of MOST_TRUTHS has a stable loop.
    """
    rng = np.random.default_rng(child(seed, TRUTH))
    redrawn = 0
    reason = ""
    for unstable in range(MOST_TRUTHS):
        truth = drawn_truth(guess, bounds, rng)
        redrawn += truth.redrawn
        plant = replace(setup.plant, parameters=truth.values)
        try:
            record, unseen = (
                random_run(
                    setup, plant, sensor, number, child(seed, TRAJECTORIES, unstable, number)
                )
                for number in (0, 1)
            )
        except LoopFailure as error:
            reason = str(error)
            continue
        return StableExperiments(plant, record, unseen, unstable, redrawn)
    raise StudyError(f"none of {MOST_TRUTHS} drawn truths has a stable loop; the last: {reason}")


def random_run(
    setup: Setup, plant: Plant, sensor: PoseSensor, number: int, seed: np.random.SeedSequence
) -> Experiment:
    """Run a plant along a random trajectory.

    Run 0 is as long as the excitation, and each other run as long as a validation.
    """
    design = setup.design
    scenario = setup.scenario
    duration_s = (scenario.validation if number else scenario.excitation).duration_s
    trajectory = admissible_trajectories(
        design.robot, design.settings, duration_s, 1, seed, design.check
    )[0]
    return run_plant(plant, sensor, trajectory, duration_s, setup.seed, number)


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: CalibrationOptions) -> Row:
    """Compute one row. Raises EstimationError, and the exceptions of experiment and sensor.

    Raises StudyError if plant and model differ in parameters, or if no truth has a stable loop.
    """
    setup = row_setup(scenario, stream_seed(seed, EXPERIMENT))
    settings = scenario.identification
    plant = setup.plant
    side = setup.side
    if plant.robot.layout.names != side.robot.layout.names:
        raise StudyError(
            "the truth is drawn from the prior of the model, so plant and model need the same "
            f"parameters: the plant has {len(plant.robot.layout.names)}, the model "
            f"{len(side.robot.layout.names)}; set inertia, gains and passive_friction alike"
        )
    guess = model_guess(side.robot, side.model, settings)
    bounds = parameter_bounds(guess, settings.physical_consistency)
    sensor = row_pose_sensor(setup, options)
    experiments = stable_experiments(setup, sensor, guess, bounds, seed)
    record, unseen = experiments.record, experiments.unseen
    logged = record.record
    if options.log_from_s > 0.0:
        logged = log_of_moving_robot(logged, options.log_from_s, side.robot)
    result = identify_record(logged, side.robot, scenario)
    (predicted,) = predicted_runs(
        side.with_drive(result.drive.law),
        [unseen.record],
        result.estimate,
        result.whole_covariance,
        setup.seed,
        SilentProgress(),
        result.common_errors.learned,
    )
    moving = moving_frames(true_poses(unseen.truth))
    frame = int(np.random.default_rng(child(seed, FRAME)).choice(moving))
    return {
        "noise_ratio": result.noise_ratio,
        "redrawn_truths": experiments.unstable,
        "redrawn_values": experiments.redrawn,
        **parameter_figures(result, experiments.plant),
        **pose_figures(predicted, unseen, frame),
    }


def log_of_moving_robot(record: xr.Dataset, from_s: float, robot: Robot) -> xr.Dataset:
    """Return the part of a record that begins at a time at which the robot already moves.

    The time of the part starts at 0, and the part holds no reference. Raises StudyError if fewer
    than two frames remain, or if the record stores, frame by frame, errors that all frames have in
    common. The returned record could not state such errors.
    """
    part = record.isel(time=np.flatnonzero(record["time"].values >= from_s))
    if part.sizes["time"] < 2:
        raise StudyError(
            f"options.log_from_s is {from_s:g} s, but the record ends after "
            f"{float(record['time'][-1]):.4g} s"
        )
    if CHANGES in record:
        raise StudyError("options.log_from_s needs options.sensor = drawn")
    began = float(part["time"][0])
    log = build_timed_record(
        time=part["time"].values - began,
        measured_pose=recorded_poses(part, "measured"),
        measured_covariance=part["measured_covariance"].values,
        measured_ok=part["measured_ok"].values,
        acting=part[COMMAND_TIME].values - began,
        command=part["command"].values,
        scenario_toml=record.attrs["scenario"],
        robot=robot.name,
        frame_rate_hz=float(record.attrs["frame_rate_hz"]),
        prismatic=robot.layout.prismatic,
    )
    store_anchor(log, read_anchor(record, robot.layout))
    return log


def parameter_figures(result: IdentificationResult, plant: Plant) -> Row:
    """Return the probability of values below each identified quantity's truth, and the coverage."""
    truth = plant.parameters_of(result.layout)
    groups = result.groups
    counted = groups.identifiable & groups.several
    combined = group_rows(groups.combinations, result.layout)
    rows = np.concatenate([np.eye(len(truth))[result.identifiable], combined[counted]])
    names = [
        *np.array(result.names)[result.identifiable],
        *np.array(groups.expressions)[counted],
    ]
    if not names:
        return {"intervals": 0}
    below = result.bounded.probabilities(rows, rows @ truth)
    return {
        "intervals": len(names),
        "covered_percent": 100.0 * float(np.mean(intervals_hold(result, plant))),
        "inner_covered_percent": 100.0 * float(np.mean(inner(below, INNER))),
        **{f"{PROBABILITY}{name}": float(one) for name, one in zip(names, below, strict=True)},
    }


def moving_frames(poses: Array) -> NDArray[np.int_]:
    """Return the indices of poses (N, 6) that differ from the first pose, or else the last index.

    While joints stick at the start, the platform rests there, and every prediction is exact.
    """
    moved = np.flatnonzero(np.abs(poses - poses[0]).max(axis=1) > AT_REST)
    return moved if len(moved) else np.array([len(poses) - 1], dtype=np.int_)


def pose_figures(predicted: PosePrediction, unseen: Experiment, frame: int) -> Row:
    """Return the probability of values below each true coordinate of a frame, and the coverage.

    Coordinates in which the platform cannot move are left out.
    """
    free = predicted.chart.basis
    error = (true_poses(unseen.truth)[frame] - predicted.poses[frame]) @ free
    std = np.sqrt(np.diag(free.T @ predicted.covariance[frame] @ free))
    below = ndtr(error / std)
    names = [POSE[int(np.argmax(np.abs(axis)))] for axis in free.T]
    return {
        "poses_covered_percent": 100.0 * float(np.mean(inner(below, 0.95))),
        "poses_inner_covered_percent": 100.0 * float(np.mean(inner(below, INNER))),
        **{f"{PROBABILITY}pose {name}": float(one) for name, one in zip(names, below, strict=True)},
    }


def inner(below: Array, probability: float) -> Array:
    """Return for each truth whether the central interval of a probability contains it, (n,) bool.

    below (n,): stated probabilities of values below the truths.
    """
    return np.asarray(np.abs(below - 0.5) < probability / 2)


CALIBRATION = Kind(
    "calibration_of_intervals",
    compute,
    "a truth drawn from the estimator's prior, identified from its record, and the probability "
    "that the stated distributions give to values below the truth",
    COLUMNS,
    CalibrationOptions,
    KeysRead(
        READS.keys,
        (*READS.excluding, "scenario.plant.parameters", "scenario.plant.values"),
        READS.ineffective,
    ),
    memory=memory,
)
