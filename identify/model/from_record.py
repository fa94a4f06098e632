"""Model of a recorded run, from the record and the model's side of a scenario.

A record that is not suitable for an identification is refused (see `identify.record.checks`).
"""

from dataclasses import replace
from math import ceil

import numpy as np
import xarray as xr
from scipy.optimize import minimize_scalar

from dynamics import DynamicsError
from dynamics.closed_loop import FrameTiming, LoopSettings, Reference
from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.filtering import filtered_derivatives, interpolated
from identify.model.common_error_prior import with_recorded_errors
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.model.stretch import Stretch, begun_stretch
from identify.model.timed_model import TimedModel, grid_times
from identify.model.torque_model import torque_model
from identify.record.checks import (
    check_channels,
    check_good_share,
    check_length,
    check_origin,
    check_plausible,
    check_reference,
    check_timed_units,
    checked_covariance,
)
from identify.record.conditions import drift_warnings, logged_latencies, takes_torques
from identify.record.frame_times import mean_rate
from identify.record.load import recorded_payload
from identify.record.recording import STRETCH, is_timed, poses, recorded_reference
from identify.record.stored_common_errors import CLOCK_DRIFT, CLOCK_OFFSET


def identified_model(record: xr.Dataset, side: ModelSide) -> LoopModel:
    """Return the model of a record that is suitable for an identification.

    Raises the errors of `predicting_model`. In addition, raises EstimationError if the record is
    too short, if a channel is constant, if the reference does not move, is too fast for the frame
    rate, or does not begin at rest, if units or frames differ from those of the robot, or if joints
    have gains of their own but the commands are torques.
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
    times = record["time"].values
    check_plausible(side.robot, run.reference, run.measured, run.ok, joint_commands, times)
    return run


def predicting_model(record: xr.Dataset, side: ModelSide) -> LoopModel:
    """Return the model of a record that is suitable for a prediction.

    Raises RecordError if something is missing, has a wrong shape or is not finite, or the payload
    is not valid. Raises TooFewFramesError if too many frames were lost. Raises EstimationError if
    the record is of another robot, timing or servo, or the covariance of its poses is not symmetric
    and positive definite. Raises also the errors of `with_recorded_errors` and, for a timed record,
    those of `timed_model`.
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
        covariance=checked_covariance(
            record["measured_covariance"].values, ok, record["time"].values
        ),
        logged=np.asarray(record["command"].values, dtype=float),
        payload=load,
        payload_errors=load_errors,
        acted=logged_latencies(record, side.timing),
    )
    # Common errors are added to the model afterwards, because they need its whitener.
    run = with_recorded_errors(run, record, side, run.reference.poses)
    return torque_model(run, side.low_pass) if takes_torques(record) else run


REACH = 4.0  # largest offset of a clock that is tried, in its standard deviations
# Smallest fraction of a record's duration over which motions are compared at every tried delay.
COMPARED = 0.5
DELAYS = 50  # number of delays of a clock, of either sign, that are tried first
# Relative difference up to which the rate of commands counts as equal to the frame rate.
SAME_RATE = 0.05


def timed_model(record: xr.Dataset, side: ModelSide) -> TimedModel:
    """Return the model of a timed record, which the commands drive.

    Raises RecordError if something is missing or not valid. Raises EstimationError if a channel is
    constant, units or frames differ from those of the robot, the covariance of the poses is not
    positive definite, or the commands are torques.
    """
    if takes_torques(record):
        raise EstimationError(
            "the commands of the record are torques, under which states are fitted from frame to "
            "frame: poses and commands must be on one frame grid (identify.build_record)"
        )
    robot = side.robot
    ok = record["measured_ok"].values.astype(bool)
    measured = poses(record, "measured")
    times = record["time"].values
    acting = record["acting"].values
    logged = np.asarray(record["command"].values, dtype=float)
    check_channels(robot.geometry.chart, measured, logged, ok)
    within = (acting >= times[ok][0]) & (acting <= times[ok][-1])
    followed = interpolated(acting[within], times[ok], measured[ok])
    check_timed_units(robot, measured[ok], times[ok], followed, logged[within], acting[within])
    covariance = checked_covariance(record["measured_covariance"].values, ok, times)
    settings = _settings(side.settings, acting)
    load, load_errors = recorded_payload(record, robot.layout)
    run = TimedModel(
        robot=robot,
        settings=settings,
        reference=_filtered_motion(side, settings.timing, times[ok], measured[ok]),
        measured=measured,
        ok=ok,
        covariance=covariance,
        logged=logged,
        payload=load,
        payload_errors=load_errors,
        driven=True,
        times=times,
        acting=acting,
        stretches=_stretches(record, side, settings, covariance),
    )
    own = _own_errors(run, side)
    return _at_likely_offset(with_recorded_errors(run, record, side, run.without_gaps(), own), side)


def _settings(settings: LoopSettings, acting: Array) -> LoopSettings:
    """Return the settings of a loop whose commands act at given times (M,), without a latency.

    The frame rate is kept, unless the times show another rate of commands, which then replaces it.
    """
    rate_hz = settings.timing.frame_rate_hz
    shown_hz = mean_rate(acting)
    if abs(rate_hz / shown_hz - 1) > SAME_RATE:
        rate_hz = shown_hz
    steps = ceil(settings.steps_per_frame * settings.timing.frame_rate_hz / rate_hz - 1e-9)
    timing = FrameTiming(rate_hz, 0.0, settings.timing.hold)
    return replace(settings, timing=timing, steps_per_frame=max(1, steps))


def _filtered_motion(
    side: ModelSide, timing: FrameTiming, times: Array, measured: Array
) -> Reference:
    """Return the measured motion, filtered, at frames one period apart."""
    chart = side.robot.geometry.chart
    grid = grid_times(times, timing.frame_rate_hz)
    coordinates = chart.coordinates(interpolated(grid, times, measured))
    low_pass = side.low_pass
    filtered, rate, _ = filtered_derivatives(
        coordinates, timing.frame_rate_hz, low_pass.cutoff_hz, low_pass.order
    )
    return Reference(chart.pose(filtered), chart.lifted(rate))


def _stretches(
    record: xr.Dataset, side: ModelSide, settings: LoopSettings, covariance: Array
) -> tuple[Stretch, ...]:
    """Return the stretches of a record, each with the start that its first poses suggest.

    Raises RecordError for a stretch with fewer than two measured poses.
    """
    robot = side.robot
    guess = robot.parameter_sets[side.model.start_parameters].vector
    law = settings.drives.joint_law(robot.layout.split(guess)[3])
    times = record["time"].values
    measured = poses(record, "measured")
    ok = record["measured_ok"].values.astype(bool)
    acting = record["acting"].values
    logged = record["command"].values
    numbers = record[STRETCH].values
    stretches = []
    for number, label in enumerate(np.unique(numbers), start=1):
        rows = np.flatnonzero(numbers == label)
        good = rows[ok[rows]]
        if len(good) < 2:
            raise RecordError(
                f"stretch {label} of the record, from {times[rows[0]]:.6g} to "
                f"{times[rows[-1]]:.6g} s, has {len(good)} measured poses, and its start needs 2"
            )
        newest = np.maximum(np.searchsorted(acting, times[good], side="right") - 1, 0)
        stretch = begun_stretch(
            robot,
            number,
            slice(int(rows[0]), int(rows[-1]) + 1),
            times[good],
            measured[good],
            covariance,
            logged[newest],
            law,
        )
        stretches.append(stretch)
    return tuple(stretches)


def _own_errors(run: TimedModel, side: ModelSide) -> dict[str, float]:
    """Return the standard deviations of the errors of a record's clock and starts, by name."""
    stds: dict[str, float] = {}
    timing = side.timing
    if "clock" in side.nuisances:
        clock = {CLOCK_OFFSET: timing.clock_offset_std_s, CLOCK_DRIFT: timing.clock_drift_std}
        stds |= {name: std for name, std in clock.items() if std}
    if "start" in side.nuisances:
        for stretch in run.stretches:
            stds |= stretch.stds
    return stds


def _at_likely_offset(run: TimedModel, side: ModelSide) -> TimedModel:
    """Return the model with the clock offset at which its motion is most like the measured one.

    The motion of the model with the initial guess is compared with the measured motion. The search
    for the parameters, which is linear in the offset, begins at this offset. The model is returned
    as it is if it has no clock offset, or if it is unstable.
    """
    stds = run.common.loop_std
    if CLOCK_OFFSET not in stds:
        return run
    guess = side.robot.parameter_sets[side.model.start_parameters].vector
    try:
        model = run.simulate(guess).pose
    except DynamicsError:
        # the search raises an error for an unstable model, with more detail
        return run
    offset = _likely_delay(
        run.times[run.ok], model[run.ok], run.measured[run.ok], REACH * stds[CLOCK_OFFSET]
    )
    drawn = np.zeros(len(run.errors_had))
    drawn[len(run.common.names) + list(stds).index(CLOCK_OFFSET)] = offset / stds[CLOCK_OFFSET]
    return replace(run, drawn=drawn)


def _likely_delay(times: Array, model: Array, measured: Array, farthest: float) -> float:
    """Return the delay, s, of measured poses (k, 6) behind those of a model at times (k,).

    It is the delay of at most `farthest`, of either sign, with the smallest squared difference.
    In a short record, delays are smaller, so that the fraction COMPARED of it remains to compare.
    Each component is divided by its standard deviation over time.
    """
    farthest = min(farthest, (1 - COMPARED) / 2 * float(times[-1] - times[0]))
    stds = measured.std(axis=0)
    moving = stds > 0
    scaled = [poses[:, moving] / stds[moving] for poses in (model, measured)]
    inner = (times > times[0] + farthest) & (times < times[-1] - farthest)

    def misfit(delay: float) -> float:
        moved = interpolated(times[inner] - delay, times, scaled[0])
        return float(np.mean((moved - scaled[1][inner]) ** 2))

    coarse = np.linspace(-farthest, farthest, 2 * DELAYS + 1)
    best = coarse[int(np.argmin([misfit(delay) for delay in coarse]))]
    step = coarse[1] - coarse[0]
    refined = minimize_scalar(misfit, bounds=(best - step, best + step), method="bounded")
    return float(refined.x)
