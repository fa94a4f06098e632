"""Rows of kind `closed_loop`: the plant follows a random trajectory with images in the loop.

Each row draws a trajectory in the scenario's box and runs it for `validation.duration_s`, with the
sensor, timing, servo and plant of the scenario. By default the sensor teaches itself, seeded by the
row.
"""

import numpy as np
from pydantic import Field

from cmmsim.teaching import exactly_taught
from identify.errors import EstimationError
from identify.excitation.design import admissible_trajectories
from identify.experiment.run import run_plant
from identify.experiment.truth import true_poses
from identify.random_streams import stream_seed
from identify.record import recording
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.setup import Setup
from identify.studies.rows.kind import (
    LIMITS,
    NOISE_OFF,
    PATH,
    PICTURES,
    PLANT,
    UNWATCHED,
    Column,
    KeysRead,
    Kind,
    Row,
)
from identify.studies.rows.row_sensor import POSE_COLUMNS, Teaching, pose_figures, rms_um

EXPERIMENT, TRAJECTORY = range(2)  # random streams of a row

COLUMNS = {
    "frames": Column("1", "frames of the run"),
    "lost_frames": Column(
        "1", "frames without a pose; the errors of measured poses exclude them", main=True
    ),
    "tracking_position_rms_um": Column(
        "um", "deviation of the true from the desired position, rms", main=True
    ),
    "tracking_orientation_rms_urad": Column(
        "urad", "deviation of the true from the desired orientation, rms", main=True
    ),
    **POSE_COLUMNS,
    "torque_rms_N_m": Column(
        "N m", "torque of the joint controllers, rms over frames and joints", main=True
    ),
}


class ClosedLoopOptions(Section):
    """Options of rows of kind `closed_loop`."""

    teaching: Teaching = Field(
        "sensor",
        description="sensor: the sensor teaches itself, seeded by the row; exact: without error",
    )


READS = KeysRead(
    (
        "scenario.robot",
        *PICTURES,
        "scenario.rig.errors",
        "scenario.rig.right_later_s",
        "scenario.rig.right_later_std_s",
        "scenario.rig.drift",
        "scenario.geometry.known",
        "scenario.timing.",
        "sensor.timing.",
        "scenario.servo.",
        "scenario.plant.",
        *PATH,
        *LIMITS,
        "scenario.validation.duration_s",
    ),
    ineffective=(NOISE_OFF, *PLANT),
)


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: ClosedLoopOptions) -> Row:
    """Compute one row.

    Raises EstimationError if no frame was measured, LoopFailure, and the exceptions of the sensor.
    """
    setup = Setup(scenario.with_overrides(UNWATCHED))
    plan = setup.sensor_plan
    number = stream_seed(seed, EXPERIMENT)
    # With None, the sensor teaches itself.
    taught = exactly_taught(plan.file) if options.teaching == "exact" else None
    sensor = plan.make(setup.robot, number, taught)
    design = setup.design
    duration = design.validation.duration_s
    stream = np.random.SeedSequence(stream_seed(seed, TRAJECTORY))
    trajectory = admissible_trajectories(
        design.robot, design.settings, duration, 1, stream, design.check
    )[0]
    run = run_plant(setup.plant, sensor, trajectory, duration, number, 1)
    ok = run.record["measured_ok"].values.astype(bool)
    if not ok.any():
        raise EstimationError(
            f"none of {len(ok)} frames was measured: {run.record.attrs['lost_frames']}"
        )
    true = true_poses(run.truth)
    tracking = true - recording.poses(run.record, "reference")
    errors = (recording.poses(run.record, "measured") - true)[ok]
    return {
        "frames": len(ok),
        "lost_frames": int(np.sum(~ok)),
        "tracking_position_rms_um": rms_um(tracking[:, :3]),
        "tracking_orientation_rms_urad": rms_um(tracking[:, 3:]),
        **pose_figures(errors, run.record["measured_covariance"].values[ok]),
        "torque_rms_N_m": float(np.sqrt(np.mean(run.truth["joint_torque"].values ** 2))),
    }


CLOSED_LOOP = Kind(
    "closed_loop",
    compute,
    "the robot follows a random trajectory with images in the loop",
    COLUMNS,
    ClosedLoopOptions,
    READS,
)
