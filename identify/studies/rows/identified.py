"""Rows of kind `identification`: a record, the parameters identified from it, and their errors.

By default the sensor is `drawn`: it adds Gaussian noise with the covariance that the scenario's
sensor states at the home pose. The keys of the sensor file therefore have an effect although no
image is drawn. With images, the sensor teaches itself, seeded by the row. All rows have the same
exciting and validation trajectories, from `trajectory_seed`. Rows thus differ only by their factors
and their noise.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import xarray as xr
from pydantic import Field

from dynamics.closed_loop import differentiate_servo
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.estimation.identification import identify as identify_record
from identify.estimation.result import IdentificationResult
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment, excitation_run, run_plant
from identify.experiment.truth import true_poses
from identify.model.model_side import ModelSide, model_side
from identify.progress import SilentProgress
from identify.random_streams import stream_seed
from identify.record.conditions import logged_latencies
from identify.record.recording import recorded_reference
from identify.scenario import Plant as PlantSwitches
from identify.scenario import Scenario, scenario_from_toml
from identify.scenario.sections import Geometry, Rig
from identify.setup import Setup
from identify.studies.rows.coverage import coverage
from identify.studies.rows.kind import (
    NOISE_OFF,
    PLANT,
    SENSOR,
    UNWATCHED,
    Column,
    IneffectiveKeys,
    KeysRead,
    Kind,
    Row,
    robot_named,
    timing,
)
from identify.studies.rows.row_sensor import SensorOptions, rms_um, row_pose_sensor, stated_um
from identify.trajectory import TrajectorySet
from identify.validation.pose_prediction import PosePrediction, predicted_runs
from identify.validation.unseen import model_on_record

EXPERIMENT = 0  # random stream of a row
CHOSEN = {
    "coulomb": ("Coulomb friction", "coulomb"),
    "viscous": ("viscous friction", "viscous"),
    "gains": ("joint gains", "joint_pid"),
}
"""Sets of parameters over which an rms is computed, with their slice of the layout.

Every record identifies these parameters, so their errors scatter in proportion to the noise.
"""

UNAWARE = "the same figure, identified without the errors that all frames have in common"
"""Meaning of all figures whose names begin with `unaware_`. Labels show their names instead."""

COLUMNS = {
    "frames": Column("1", "frames of the record"),
    "lost_frames": Column("1", "frames of the record without a pose"),
    "pose_noise_um": Column(
        "um", "stated standard deviation of a measured position, rms over frames and axes"
    ),
    "pose_noise_urad": Column(
        "urad", "stated standard deviation of a measured orientation, rms over frames and axes"
    ),
    **{
        f"{name}_{figure}_percent": Column(
            "%", f"{words} of {what}, rms relative to the truth", main=figure == "std"
        )
        for figure, words in (("std", "stated standard deviation"), ("error", "error"))
        for name, (what, _) in CHOSEN.items()
    },
    "identified_groups": Column("1", "base parameters that the record identifies"),
    "group_std_percent": Column(
        "%", "stated standard deviation of identified groups, relative, median", main=True
    ),
    "normalised_error": Column(
        "1",
        "error of identified groups over the stated standard deviation, rms; 1 is correct",
    ),
    "intervals": Column(
        "1", "quantities that the record identifies: parameters, and groups of several"
    ),
    "covered_percent": Column(
        "%", "fraction of these 95 % intervals that contain the truth", main=True
    ),
    "noise_ratio": Column(
        "1", "mean squared residual over the variance of the noise; 1 if only noise remains"
    ),
    "iterations": Column("1", "iterations of all searches"),
    "prediction_rms_um": Column(
        "um", "error of the identified model's position on validation trajectories, without noise"
    ),
    "stated_prediction_rms_um": Column(
        "um", "error of the model's position according to the covariance of the parameters"
    ),
    "unseen_position_rms_um": Column(
        "um", "error of the model's position on validation trajectories, rms over axes", main=True
    ),
    "unseen_orientation_rms_urad": Column(
        "urad",
        "error of the model's orientation on validation trajectories, rms over axes",
        main=True,
    ),
    "poses_covered_percent": Column(
        "%",
        "fraction of true coordinates on validation trajectories in the predicted 95 % intervals",
    ),
    "predicted_position_rms_um": Column(
        "um",
        "error of the predicted position on validation trajectories, with the estimated errors of "
        "sensor and geometry",
    ),
    "unaware_intervals": Column("1", UNAWARE),
    "unaware_covered_percent": Column("%", UNAWARE),
    "unaware_poses_covered_percent": Column("%", UNAWARE),
    "unaware_predicted_position_rms_um": Column("um", UNAWARE),
}


class RecordOptions(SensorOptions):
    """Options of the record."""

    trajectory_seed: int = Field(
        0, ge=0, description="seed of the exciting and the validation trajectories"
    )


class IdentificationOptions(RecordOptions):
    """Options of rows of kind `identification`."""

    unaware: bool = Field(
        False,
        description="also identify as if cameras, teaching, clocks and geometry were exact",
    )


DRAWN = {"options.sensor": lambda sensor: sensor == "drawn"}
READS = KeysRead(
    ("scenario.", *SENSOR, "sensor.timing."),
    excluding=(
        "scenario.name",
        "scenario.description",
        "scenario.sensor_note",
        "scenario.identification.qr_threshold",
        "scenario.rig.watch",
    ),
    ineffective=(
        IneffectiveKeys(
            NOISE_OFF.keys,
            {**NOISE_OFF.where, "options.sensor": lambda sensor: sensor == "images"},
            NOISE_OFF.why,
        ),
        IneffectiveKeys(
            ("sensor.camera.noise",),
            DRAWN,
            "options.sensor is drawn: the stated noise is added in any case",
        ),
        IneffectiveKeys(
            ("scenario.renderer", "sensor.stickers.obstacle_level", *timing("exposure_s")),
            DRAWN,
            "options.sensor is drawn: no picture of a motion is taken",
        ),
        IneffectiveKeys(
            ("scenario.payload.",),
            {"scenario.identification.scale_anchor": lambda anchor: anchor != "payload"},
            "scenario.identification.scale_anchor is not payload",
        ),
        IneffectiveKeys(
            ("scenario.excitation.generations",),
            {"scenario.excitation.method": lambda how: how != "evolutionary"},
            "scenario.excitation.method is not evolutionary",
        ),
        *PLANT,
    ),
)


@dataclass(frozen=True)
class Recorded:
    """Runs of a row.

    `excitation` is the plant's run of the exciting trajectory, and `unseen` are the plant's runs of
    the validation trajectories. `records` are all records to identify from, first the record of
    `excitation`. `number` is the seed of all runs.
    """

    plant: Plant
    excitation: Experiment
    records: list[xr.Dataset]
    unseen: list[Experiment]
    number: int


def row_setup(settings: Scenario, number: int) -> Setup:
    """Return the setup of a row with a seed. Rows with the same robot share the loaded robot."""
    return Setup(settings.with_overrides(UNWATCHED), number, robot_named(settings.robot))


def recorded(setup: Setup, options: RecordOptions) -> Recorded:
    """Run the plant of a row with its sensor. Raises the exceptions of experiment and sensor."""
    number = setup.seed
    settings = setup.scenario.excitation
    plant = setup.plant
    trajectories = designed_trajectories(setup, options.trajectory_seed)
    sensor = row_pose_sensor(setup, options)
    arguments = (plant, sensor, trajectories.excitation, settings, number)
    experiment = excitation_run(*arguments)
    records = [experiment.record]
    if plant.runs.anchor == "payload":
        records.append(excitation_run(*arguments, payload=setup.scenario.payload).record)
    duration_s = setup.scenario.validation.duration_s
    unseen = [
        run_plant(plant, sensor, trajectory, duration_s, number, run)
        for run, trajectory in enumerate(trajectories.validation, start=1)
    ]
    return Recorded(plant, experiment, records, unseen, number)


def compute(
    scenario: Scenario, seed: np.random.SeedSequence, options: IdentificationOptions
) -> Row:
    """Compute one row. Raises EstimationError, and the exceptions of experiment and sensor."""
    runs = recorded(row_setup(scenario, stream_seed(seed, EXPERIMENT)), options)
    plant = runs.plant
    robot = plant.nominal
    records = [one.record for one in runs.unseen]
    scenarios = {"": scenario}
    if options.unaware:
        scenarios["unaware_"] = scenario.with_overrides({"identification.nuisances": []})
    row: Row = {}
    for prefix, settings in scenarios.items():
        result = identify_record(runs.records, robot, settings)
        # The model is run with the identified law of the drives.
        side = model_side(robot, settings).with_drive(result.drive.law)
        predicted = predicted_runs(
            side,
            records,
            result.estimate,
            result.whole_covariance,
            runs.number,
            SilentProgress(),
            result.common_errors.learned,
        )
        true = plant.parameters_of(result.layout)
        if not prefix:
            row |= _record_figures(runs.excitation) | _parameter_figures(result, true)
            row |= _unseen_figures(result, side, true, runs.unseen, predicted)
        covered = coverage(result, plant, runs.unseen, predicted)
        row |= {f"{prefix}{name}": value for name, value in covered.items()}
    return row


def _unseen_figures(
    result: IdentificationResult,
    side: ModelSide,
    truth: Array,
    unseen: list[Experiment],
    predicted: list[PosePrediction],
) -> Row:
    """Return the errors of the identified model on the validation trajectories.

    truth: true parameters (p,).
    """
    groups = structure(side.robot).rigid_groups
    models = []
    for prediction, one in zip(predicted, unseen, strict=True):
        if prediction.slopes is not None:  # the prediction is already a run of the identified model
            models.append((prediction.poses, prediction.slopes))
            continue
        reference = recorded_reference(one.record)
        latencies = logged_latencies(one.record, side.timing)
        run = differentiate_servo(
            side.robot,
            result.estimate,
            reference,
            side.settings,
            latencies=latencies,
            groups=groups,
        )
        assert run.pose_sensitivity is not None
        models.append((run.pose, groups.of_all(run.pose_sensitivity)))
    true = [model_on_record(side, truth, one.record) for one in unseen]
    errors = np.concatenate(
        [poses - true_poses(one.truth) for (poses, _), one in zip(models, unseen, strict=True)]
    )
    return prediction_figures(models, result.covariance, true) | {
        "unseen_position_rms_um": rms_um(errors[:, :3]),
        "unseen_orientation_rms_urad": rms_um(errors[:, 3:]),
    }


def _record_figures(experiment: Experiment) -> Row:
    ok = experiment.record["measured_ok"].values.astype(bool)
    position, orientation = stated_um(experiment.record["measured_covariance"].values[ok])
    return {
        "frames": len(ok),
        "lost_frames": int(np.sum(~ok)),
        "pose_noise_um": position,
        "pose_noise_urad": orientation,
    }


def _parameter_figures(result: IdentificationResult, truth: Array) -> Row:
    row: Row = {}
    for figure, values in (("std", result.std), ("error", result.estimate - truth)):
        for name, (_, members) in CHOSEN.items():
            index = np.arange(len(truth))[getattr(result.layout, members)]
            index = index[truth[index] != 0]  # drives can lack a gain
            row[f"{name}_{figure}_percent"] = 100.0 * float(
                np.sqrt(np.mean((values[index] / truth[index]) ** 2))
            )
    groups = result.groups
    true_groups = groups.combinations @ truth[result.layout.dynamic]
    seen = groups.identifiable
    row["identified_groups"] = int(seen.sum())
    # If a wrong model identifies nothing, the row has only its other figures.
    if seen.any():
        normalised = (groups.estimate - true_groups)[seen] / groups.std[seen]
        sized = seen & (true_groups != 0)  # first moments and products of inertia can be zero
        row["group_std_percent"] = 100.0 * float(
            np.median(groups.std[sized] / np.abs(true_groups[sized]))
        )
        row["normalised_error"] = float(np.sqrt(np.mean(normalised**2)))
    return row | {"noise_ratio": result.noise_ratio, "iterations": result.iterations}


def prediction_figures(
    models: list[tuple[Array, Array]], covariance: Array, true: list[Array]
) -> Row:
    """Return the model's position error, and the error that the covariance of parameters predicts.

    `models` holds, for each trajectory, the poses (N, 6) of the estimated model and their
    derivatives (N, 6, p) with respect to the parameters. `true` holds the poses (N, 6) of the true
    model. Errors of positions scatter less from row to row than errors of single parameters.
    """
    squares = []
    stated = []
    for (poses, slopes), true_ones in zip(models, true, strict=True):
        positions = slopes[:, :3]
        squares.append(float(np.mean((poses - true_ones)[:, :3] ** 2)))
        variances = np.einsum("nip,pq,niq->ni", positions, covariance, positions, optimize=True)
        stated.append(float(np.mean(variances)))
    return {
        "prediction_rms_um": 1e6 * float(np.sqrt(np.mean(squares))),
        "stated_prediction_rms_um": 1e6 * float(np.sqrt(np.mean(stated))),
    }


def designed_trajectories(setup: Setup, seed: int) -> TrajectorySet:
    """Return the trajectories of a setup, designed once per process.

    The design does not depend on the renderer, nor on the sections plant, rig and geometry of the
    scenario. Rows that differ only there share their trajectories.
    """
    design = {"rig": Rig(), "plant": PlantSwitches(), "geometry": Geometry(), "renderer": "auto"}
    return _designed(setup.scenario.model_copy(update=design).to_toml(), seed)


@lru_cache(maxsize=64)
def _designed(scenario_toml: str, seed: int) -> TrajectorySet:
    settings = scenario_from_toml(scenario_toml)
    return Setup(settings, seed, robot_named(settings.robot)).trajectories


HELD = 5
"""Number of arrays in memory at once, each as large as the sensitivities of all poses."""


def memory(setup: Setup, options: object) -> float:
    """Return the memory needed to identify from the records of a setup, bytes.

    The formula was checked with up to 24,000 frames.
    """
    return HELD * 8.0 * 6 * len(setup.nominal.layout.names) * setup.sensor_plan.frames


IDENTIFICATION = Kind(
    "identification",
    compute,
    "a record of the exciting trajectory, the parameters identified from it, and their errors",
    COLUMNS,
    IdentificationOptions,
    READS,
    memory=memory,
)
