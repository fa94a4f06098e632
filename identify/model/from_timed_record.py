"""Model of a timed record, in which poses and commands have times of their own."""

from dataclasses import replace
from math import ceil

import numpy as np
import xarray as xr
from scipy.optimize import minimize_scalar

from dynamics import DynamicsError
from dynamics.closed_loop import FrameTiming, LoopSettings, Reference
from identify.arrays import Array
from identify.errors import EstimationError
from identify.filtering import filtered_derivatives, interpolated
from identify.model.common_error_prior import with_recorded_errors
from identify.model.model_side import ModelSide
from identify.model.stretch import Stretch, begun_stretch
from identify.model.timed_model import TimedModel, grid_times
from identify.record.checks import (
    check_channels,
    check_timed_units,
    checked_covariance,
)
from identify.record.conditions import takes_torques
from identify.record.frame_times import mean_rate
from identify.record.load import recorded_payload
from identify.record.recording import STRETCH, poses
from identify.record.stored_common_errors import CLOCK_DRIFT, CLOCK_OFFSET

REACH = 4.0
"""Largest offset of a clock that is tried, in its standard deviations."""

DELAYS = 50
"""Number of delays of a clock, of either sign, that are tried first."""

SAME_RATE = 0.05
"""Relative difference up to which the rate of commands counts as equal to the frame rate."""


def timed_model(record: xr.Dataset, side: ModelSide) -> TimedModel:
    """Return the model of a timed record, which the commands drive.

    Raises
    ------
    RecordError
        Something is missing or not valid.
    EstimationError
        A channel is constant, units or frames differ from those of the robot, the covariance of
        the poses is not positive definite, or the commands are torques.
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
    check_timed_units(robot, measured[ok], followed, logged[within])
    covariance = checked_covariance(record["measured_covariance"].values, ok)
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

    The rate of commands is the frame rate, unless the times show another one.
    """
    rate_hz = settings.timing.frame_rate_hz
    found = mean_rate(acting)
    if abs(rate_hz / found - 1) > SAME_RATE:
        rate_hz = found
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
    place, rate, _ = filtered_derivatives(
        coordinates, timing.frame_rate_hz, low_pass.cutoff_hz, low_pass.order
    )
    return Reference(chart.pose(place), chart.lifted(rate))


def _stretches(
    record: xr.Dataset, side: ModelSide, settings: LoopSettings, covariance: Array
) -> tuple[Stretch, ...]:
    """Return the stretches of a record, each with the start that its first poses suggest."""
    robot = side.robot
    guess = robot.parameter_sets[side.model.start_parameters].vector
    law = settings.drives.joint_law(robot.layout.split(guess)[3])
    times = record["time"].values
    measured = poses(record, "measured")
    ok = record["measured_ok"].values.astype(bool)
    acting = record["acting"].values
    logged = record["command"].values
    numbers = record[STRETCH].values
    found = []
    for place, number in enumerate(np.unique(numbers), start=1):
        rows = np.flatnonzero(numbers == number)
        good = rows[ok[rows]]
        newest = np.maximum(np.searchsorted(acting, times[good], side="right") - 1, 0)
        begun = begun_stretch(
            robot,
            place,
            slice(int(rows[0]), int(rows[-1]) + 1),
            times[good],
            measured[good],
            covariance,
            logged[newest],
            law,
        )
        found.append(begun)
    return tuple(found)


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

    The motion of the model with the initial guess is correlated with the measured motion. The
    search for the parameters, which is linear in the offset, begins there.
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

    It is the delay up to `farthest` with the smallest squared difference, each component in units
    of its spread.
    """
    spread = measured.std(axis=0)
    moving = spread > 0
    scaled = [one[:, moving] / spread[moving] for one in (model, measured)]
    inner = (times > times[0] + farthest) & (times < times[-1] - farthest)

    def apart(delay: float) -> float:
        moved = interpolated(times[inner] - delay, times, scaled[0])
        return float(np.mean((moved - scaled[1][inner]) ** 2))

    coarse = np.linspace(-farthest, farthest, 2 * DELAYS + 1)
    best = coarse[int(np.argmin([apart(delay) for delay in coarse]))]
    step = coarse[1] - coarse[0]
    found = minimize_scalar(apart, bounds=(best - step, best + step), method="bounded")
    return float(found.x)
