"""Troubles between the plant and its record: clocks, scale of commands, noise and gross errors."""

import re
from collections.abc import Callable

import numpy as np
import xarray as xr

from identify.diagnosis.diagnosis import Finding
from identify.diagnosis.measurement_causes import KINDS
from identify.record.conditions import COMMAND_TIME
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.studies.rows.gauntlet.trouble import (
    Laboratory,
    Remedied,
    Trouble,
    log_uniform,
    sign,
    typed,
)
from identify.studies.rows.gauntlet.troubled_plants import late_plant

# Standard deviation with which a laboratory states a latency that a diagnosis has found. It is so
# large that the record itself determines the latency.
LATENCY_STD_S = 1e-3
SCALE_STD = 1e-4  # standard deviation that a record states for the scale of its cameras
MOST_FRAMES = 4  # largest number of frames with gross errors
# Pattern of a remedy that marks a frame as lost. It captures the number of the frame.
FRAME = re.compile(r"mark frame (\d+)")


def late_by(seconds: float, per_second: float = 0.0) -> Callable[[xr.Dataset], xr.Dataset]:
    """Return a function that makes the stated times of a record's commands later.

    seconds: delay at the first frame, s. per_second: growth of the delay in each second.
    """

    def later(record: xr.Dataset) -> xr.Dataset:
        time = record["time"].values
        acted = record[COMMAND_TIME].values + seconds + per_second * time
        # no command acts before its frame
        return record.assign({COMMAND_TIME: (record[COMMAND_TIME].dims, np.maximum(acted, time))})

    return later


def latency(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw commands that act later than the record says."""
    size = log_uniform(rng, 3e-3, 12e-3)

    def remedy(finding: Finding) -> Remedied:
        found = next((one.value for one in finding.sizes if one.unit == "s"), 0.0)
        settings = {
            "timing.latency_s": max(lab.scenario.timing.latency_s + found, 0.0),
            "timing.latency_std_s": LATENCY_STD_S,
        }
        return Remedied(settings, late_by(found))

    return Trouble(
        kind="latency",
        size=size,
        unit="s",
        groups=("latency of the commands",),
        cause="latency of the commands",
        plant=lambda plant: late_plant(plant, size, 0.0),
        remedy=remedy,
    )


def drift(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a clock of the commands that falls behind."""
    size = log_uniform(rng, 4e-4, 2e-3)

    def remedy(finding: Finding) -> Remedied:
        found = next((one.value for one in finding.sizes if one.unit == "s/s"), 0.0)
        return Remedied({}, late_by(0.0, found))

    return Trouble(
        kind="clock drift",
        size=size,
        unit="s/s",
        groups=("drift of the commands' clock",),
        cause="drift of the commands' clock",
        plant=lambda plant: late_plant(plant, 0.0, size),
        remedy=remedy,
    )


def scale(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a wrong ratio of gears or encoders: joints move further or less than the log says."""
    size = sign(rng) * log_uniform(rng, 1e-3, 6e-3)
    return Trouble(
        kind="command scale",
        size=size,
        unit="1",
        groups=("scale of the commands",),
        cause="scale of the commands",
        settings={"plant.command_scale": 1.0 + size},
        remedy=typed,
    )


def stated_noise(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a sensor that states less noise than it has."""
    size = log_uniform(rng, 1.5, 3.0)

    def by(ratio: float) -> Callable[[xr.Dataset], xr.Dataset]:
        def scaled(record: xr.Dataset) -> xr.Dataset:
            stated = record["measured_covariance"]
            return record.assign(measured_covariance=(stated.dims, stated.values * ratio**2))

        return scaled

    def remedy(finding: Finding) -> Remedied:
        return Remedied({}, by(float(np.mean([one.value for one in finding.sizes]))))

    return Trouble(
        kind="stated noise",
        size=size,
        unit="1",
        groups=("noise of the sensor",),
        cause="noise of the positions",
        record=by(1.0 / size),
        remedy=remedy,
    )


def gross_errors(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw some frames with a position error of one size in any direction."""
    frames = lab.scenario.timing.frames(lab.scenario.excitation.duration_s)
    count = int(rng.integers(1, MOST_FRAMES + 1))
    spoilt_frames = rng.choice(np.arange(5, frames - 5), size=count, replace=False)
    size = log_uniform(rng, 2e-4, 2e-3)
    directions = rng.standard_normal((count, 3))
    errors = size * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def spoilt(record: xr.Dataset) -> xr.Dataset:
        position = record["measured_position"]
        values = position.values.copy()
        values[spoilt_frames] += errors
        return record.assign(measured_position=(position.dims, values))

    def remedy(finding: Finding) -> Remedied:
        found = {int(one) for text in finding.remedies for one in FRAME.findall(text)}
        # the servo has used these frames, so a model that closes its own loop without them would
        # simulate a different loop
        settings = {"identification.method": "command_driven"}
        return Remedied(settings, lambda record: without_frames(record, sorted(found)))

    return Trouble(
        kind="gross errors",
        size=size,
        unit="m",
        groups=("gross errors",),
        record=spoilt,
        remedy=remedy,
    )


def cameras(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw cameras whose scale is off by more than their calibration states."""
    size = sign(rng) * log_uniform(rng, 1e-3, 5e-3)
    name = "rig.scale_1"

    def scaled(record: xr.Dataset) -> xr.Dataset:
        position = record["measured_position"]
        changes = np.zeros((len(position), 6, 1))
        changes[:, :3, 0] = position.values - np.nanmean(position.values, axis=0)
        off = position.values + size * changes[:, :3, 0]
        record = record.assign(measured_position=(position.dims, off))
        stated = np.array([[SCALE_STD**2]])
        store_common_errors(record, CommonErrors((name,), np.nan_to_num(changes), stated))
        return record

    return Trouble(
        kind="cameras",
        size=size,
        unit="1",
        groups=(KINDS["rig"],),
        cause=f"error {name}",
        record=scaled,
    )


def without_frames(record: xr.Dataset, frames: list[int]) -> xr.Dataset:
    """Return a record in which some frames are marked as lost."""
    ok = record["measured_ok"]
    values = ok.values.copy()
    values[frames] = 0
    return record.assign(measured_ok=(ok.dims, values))
