"""Model of a recorded run, from the record and the model's side of a scenario.

A record that cannot carry an identification is refused, see `identify.record.checks`.
"""

from dataclasses import replace

import numpy as np
import xarray as xr

from dynamics import Robot
from identify.loop_parameters import model_settings
from identify.model.loop_model import LoopModel
from identify.model.torque_model import torque_model
from identify.record.checks import (
    check_channels,
    check_good_share,
    check_length,
    check_origin,
    check_reference,
    checked_covariance,
)
from identify.record.command_times import logged_latencies
from identify.record.drift import drift_warnings
from identify.record.geometry_errors import GeometryErrors, read_geometry_covariance
from identify.record.payload import recorded_payload
from identify.record.plausibility import check_plausible
from identify.record.recorded_law import takes_torques
from identify.record.recording import poses, recorded_reference
from identify.record.stored_common_errors import CommonErrors, read_common_errors
from identify.scenario import Scenario


def identified_model(record: xr.Dataset, robot: Robot, scenario: Scenario) -> LoopModel:
    """Return the model of a record that can carry an identification.

    Raises
    ------
    RecordError, EstimationError
        As `predicting_model`. An EstimationError also tells that the record is too short, that a
        channel is constant, or that the reference stands still, is faster than the frames can
        show, does not begin at rest, or is in other units or frames than the robot's.
    """
    check_origin(record, robot, scenario)
    check_length(record.sizes["time"], scenario)
    run = _model(record, robot, scenario)
    check_reference(run.reference, scenario)
    check_channels(robot.geometry.chart, run.measured, run.logged, run.ok)
    # torques cannot be compared with joint coordinates
    joint_commands = None if run.settings.drives.torques else run.logged
    check_plausible(robot, run.reference, run.measured, run.ok, joint_commands)
    return run


def predicting_model(record: xr.Dataset, robot: Robot, scenario: Scenario) -> LoopModel:
    """Return the model of a record that is long enough for a prediction at least.

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
    check_origin(record, robot, scenario)
    return _model(record, robot, scenario)


def _model(record: xr.Dataset, robot: Robot, scenario: Scenario) -> LoopModel:
    """Combine what a record holds with what the scenario says of the model."""
    ok = record["measured_ok"].values.astype(bool)
    check_good_share(ok, drift_warnings([record]))
    load, load_std = recorded_payload(record, robot.layout)
    run = LoopModel(
        robot=robot,
        settings=model_settings(robot, scenario),
        reference=recorded_reference(record),
        measured=poses(record, "measured"),
        ok=ok,
        covariance=checked_covariance(record["measured_covariance"].values, ok),
        logged=np.asarray(record["command"].values, dtype=float),
        payload=load,
        payload_std=load_std,
        acted=logged_latencies(record, scenario.timing),
    )
    run = replace(run, common=_common_errors(record, scenario, run))
    if not takes_torques(record):
        return run
    return torque_model(run, scenario)


def _common_errors(record: xr.Dataset, scenario: Scenario, run: LoopModel) -> CommonErrors:
    """Common errors of the poses that a scenario has estimated beside the parameters."""
    kinds = tuple(scenario.identification.nuisances)
    geometry = None
    covariance = read_geometry_covariance(record, run.robot) if "geometry" in kinds else None
    if covariance is not None:
        geometry = GeometryErrors(run.robot, covariance, run.reference.poses, run.whitener)
    latency_std = scenario.timing.latency_std_s if "latency" in kinds else 0.0
    of_poses = read_common_errors(record, kinds)
    return replace(of_poses, latency_std=latency_std, geometry=geometry, whitener=run.whitener)
