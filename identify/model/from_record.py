"""Model of a recorded run, from the record and the model's side of a scenario.

A record that is not suitable for an identification is refused, see `identify.record.checks`.
"""

import numpy as np
import xarray as xr

from identify.errors import EstimationError
from identify.model.common_error_prior import with_recorded_errors
from identify.model.from_timed_record import timed_model
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.model.torque_model import torque_model
from identify.record.checks import (
    check_channels,
    check_good_share,
    check_length,
    check_origin,
    check_plausible,
    check_reference,
    checked_covariance,
)
from identify.record.conditions import drift_warnings, logged_latencies, takes_torques
from identify.record.load import recorded_payload
from identify.record.recording import is_timed, poses, recorded_reference


def identified_model(record: xr.Dataset, side: ModelSide) -> LoopModel:
    """Return the model of a record that is suitable for an identification.

    Raises
    ------
    RecordError, EstimationError
        The errors of `predicting_model`. In addition, EstimationError if the record is too short,
        if a channel is constant, if the reference does not move, is too fast for the frame rate, or
        does not begin at rest, or if units or frames differ from those of the robot.
    """
    check_origin(record, side.robot, side.timing, side.settings.servo)
    # Checked before the model is made, because a short record cannot be filtered.
    check_length(record.sizes["time"], side.fewest_frames, side.timing.frame_rate_hz)
    if takes_torques(record) and side.robot.layout.own_gains:
        raise EstimationError(
            "model.gains = 'each', but the commands of the record are torques, and no gain of a "
            "joint acts under them: set model.gains = 'shared'"
        )
    if is_timed(record):
        return timed_model(record, side)
    run = _model(record, side)
    check_reference(run.reference, side.timing.frame_rate_hz)
    check_channels(side.robot.geometry.chart, run.measured, run.logged, run.ok)
    # Torques cannot be compared with joint coordinates.
    joint_commands = None if run.settings.drives.torques else run.logged
    check_plausible(side.robot, run.reference, run.measured, run.ok, joint_commands)
    return run


def predicting_model(record: xr.Dataset, side: ModelSide) -> LoopModel:
    """Return the model of a record that is suitable for a prediction.

    Raises
    ------
    RecordError
        Something is missing, has a wrong shape or is not finite, or the payload is not valid.
    TooFewFramesError
        Too many frames were lost.
    EstimationError
        The record is of another robot, timing or servo, or the covariance of its poses is not
        symmetric and positive definite.
    """
    check_origin(record, side.robot, side.timing, side.settings.servo)
    return timed_model(record, side) if is_timed(record) else _model(record, side)


def _model(record: xr.Dataset, side: ModelSide) -> LoopModel:
    """Return the model of a record, from its data and the knowledge of the estimator."""
    robot = side.robot
    ok = record["measured_ok"].values.astype(bool)
    check_good_share(ok, drift_warnings([record]))
    load, load_errors = recorded_payload(record, robot.layout)
    run = LoopModel(
        robot=robot,
        settings=side.settings,
        reference=recorded_reference(record),
        measured=poses(record, "measured"),
        ok=ok,
        covariance=checked_covariance(record["measured_covariance"].values, ok),
        logged=np.asarray(record["command"].values, dtype=float),
        payload=load,
        payload_errors=load_errors,
        acted=logged_latencies(record, side.timing),
    )
    # Common errors are added to the model afterwards, because they need its whitener.
    run = with_recorded_errors(run, record, side, run.reference.poses)
    return torque_model(run, side.low_pass) if takes_torques(record) else run
