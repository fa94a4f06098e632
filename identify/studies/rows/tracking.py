"""Rows of kind `tracking`: a control law that knows a model follows validation trajectories.

For comparison, the plant also follows the same motions under `pid`, with the same noise. The model
is the initial guess, a model identified from a record of this row, or the true model. The options
`model_error` and `off` give a model between the truth and the initial guess, and a model with a
relative error in all parameters.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from dynamics.control.inverse_dynamics import GUESSED_DOUBT
from identify.estimation.identification import identify
from identify.experiment.law_in_loop import KnownModel
from identify.experiment.run import excitation_run
from identify.experiment.sensor_in_loop import teach
from identify.progress import SilentProgress
from identify.random_streams import stream_seed
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.setup import Setup
from identify.studies.rows.identified import designed_trajectories, row_setup
from identify.studies.rows.kind import (
    NOISE_OFF,
    PICTURES,
    PLANT,
    Column,
    KeysRead,
    Kind,
    Row,
)
from identify.studies.rows.row_sensor import rms_um
from identify.tracking.following import TrackingRun
from identify.tracking.motions import motions
from identify.tracking.track import follow_by_images, known_model, model_of_result

EXPERIMENT, SIGNS = range(2)  # random streams of a row
AXES = (("position", slice(0, 3), "um"), ("orientation", slice(3, 6), "urad"))

COLUMNS = {
    "position_rms_um": Column(
        "um", "deviation of the true from the desired position, rms", main=True
    ),
    "orientation_rms_urad": Column(
        "urad", "deviation of the true from the desired orientation, rms", main=True
    ),
    "pid_position_rms_um": Column("um", "deviation of the position under the law pid, rms"),
    "pid_orientation_rms_urad": Column(
        "urad", "deviation of the orientation under the law pid, rms"
    ),
    "position_share_percent": Column(
        "%", "deviation of the position, relative to the law pid", main=True
    ),
    "orientation_share_percent": Column(
        "%", "deviation of the orientation, relative to the law pid", main=True
    ),
    "observer_normalised_error": Column(
        "1", "mean squared error of the observer over the stated variance"
    ),
    "starting_position_excess_um": Column(
        "um",
        "increase of the position's deviation with the initial guess in place of the row's model",
        main=True,
    ),
    "starting_orientation_excess_urad": Column(
        "urad",
        "increase of the orientation's deviation with the initial guess in place of the row's "
        "model",
        main=True,
    ),
    "true_position_ratio": Column(
        "1", "deviation of the position, relative to the true model", main=True
    ),
    "true_orientation_ratio": Column(
        "1", "deviation of the orientation, relative to the true model", main=True
    ),
    "effort_rms": Column("N m or N", "torque or force of the actuators, rms"),
    "lost_frames": Column("1", "frames that the sensor lost"),
}


class TrackingOptions(Section):
    """Options of rows of kind `tracking`: the law, and the model that it knows."""

    law: str = Field(
        "feedforward", description="pid, feedforward, computed_torque, or module:function"
    )
    model: Literal["initial", "identified", "true"] = Field(
        "true", description="model that the law knows"
    )
    model_error: float | None = Field(
        None,
        ge=0,
        description="distance of the model from the truth, 1: as far as the initial guess; it "
        "replaces the option model",
    )
    off: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="relative error of each parameter, with a random sign",
    )
    compared: bool = Field(
        False,
        description="whether the same motions are also followed with the initial guess and with "
        "the true model",
    )
    trajectory_seed: int = Field(
        0, ge=0, description="seed of the trajectory from which the model is identified"
    )


READS = KeysRead(
    (
        *PICTURES,
        "scenario.robot",
        "scenario.rig.",
        "scenario.geometry.known",
        "scenario.timing.",
        "sensor.timing.",
        "scenario.servo.",
        "scenario.plant.",
        "scenario.model.",
        "scenario.control.",
        "scenario.validation.",
        "scenario.excitation.",
        "scenario.identification.",
    ),
    ineffective=(NOISE_OFF, *PLANT),
)


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: TrackingOptions) -> Row:
    """Compute one row. Raises LoopFailure, and errors of sensor, identification and laws."""
    number = stream_seed(seed, EXPERIMENT)
    setup = row_setup(scenario, number)
    plant = setup.plant
    sensor = setup.sensor
    teach(sensor, SilentProgress())
    signs = np.random.default_rng(stream_seed(seed, SIGNS)).choice(
        [-1.0, 1.0], len(setup.robot.layout.names)
    )
    model = _model(setup, options)
    if options.off:
        model = replace(
            model, parameters=model.parameters * (1.0 + options.off * signs), doubt=GUESSED_DOUBT
        )
    # `motions` also returns a circle and a square, which are not used here.
    unseen = motions(setup.design, number)[: setup.design.validation.count]

    def followed(law: str, known: KnownModel) -> list[TrackingRun]:
        return [
            follow_by_images(plant, sensor, law, known, motion, number, k)[0]
            for k, motion in enumerate(unseen)
        ]

    runs = followed(options.law, model)
    under_pid = followed("pid", model)
    normalised = [one.normalised_squared_error(setup.nominal) for one in runs]
    known = [value for value in normalised if value is not None]
    row = _figures(runs, under_pid)
    if options.compared:
        start, truth = (
            followed(options.law, known_model(plant, name)) for name in ("initial", "true")
        )
        row |= _against(runs, start, truth)
    return row | ({"observer_normalised_error": float(np.mean(known))} if known else {})


def _model(setup: Setup, options: TrackingOptions) -> KnownModel:
    plant = setup.plant
    if options.model_error is not None:
        start, truth = (known_model(plant, name) for name in ("initial", "true"))
        between = truth.parameters + options.model_error * (start.parameters - truth.parameters)
        return replace(start if options.model_error else truth, parameters=between)
    if options.model != "identified":
        return known_model(plant, options.model)
    settings = setup.scenario.excitation
    trajectory = designed_trajectories(setup, options.trajectory_seed).excitation
    record = excitation_run(plant, setup.sensor, trajectory, settings, setup.seed).record
    return model_of_result(identify(record, setup.robot, setup.scenario))


def _rms(runs: list[TrackingRun], axes: slice) -> float:
    return rms_um(np.concatenate([one.errors for one in runs])[:, axes])


def _against(done: list[TrackingRun], start: list[TrackingRun], truth: list[TrackingRun]) -> Row:
    row: Row = {}
    for name, axes, unit in AXES:
        with_own, with_start, with_truth = (_rms(runs, axes) for runs in (done, start, truth))
        # If the platform cannot move along these axes, the errors are zero and have no ratio.
        if with_truth:
            row |= {
                f"starting_{name}_excess_{unit}": with_start - with_own,
                f"true_{name}_ratio": with_own / with_truth,
            }
    return row


def _figures(done: list[TrackingRun], under_pid: list[TrackingRun]) -> Row:
    row: Row = {}
    for name, axes, unit in AXES:
        own, pid = (_rms(runs, axes) for runs in (done, under_pid))
        row |= {f"{name}_rms_{unit}": own, f"pid_{name}_rms_{unit}": pid}
        row |= {f"{name}_share_percent": 100.0 * own / pid} if pid else {}
    torque = np.concatenate([one.run.torque for one in done])
    lost = sum(int((~one.run.measured_ok).sum()) for one in done)
    return row | {"effort_rms": float(np.sqrt(np.mean(torque**2))), "lost_frames": lost}


TRACKING = Kind(
    "tracking",
    compute,
    "the robot follows validation trajectories under a law with a model",
    COLUMNS,
    TrackingOptions,
    READS,
)
