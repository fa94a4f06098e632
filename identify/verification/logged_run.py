"""Telemetry of a run, and quantities derived from it before anything is identified.

The guessed model runs under the logged commands, from rest at the first measured pose. Its
parameters are the initial guess, with ordinary friction where the guess has none: a robot without
friction would swing at each command.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import closed_loop, load_robot
from dynamics.closed_loop import ClosedLoopRun, Reference
from dynamics.errors import DynamicsError
from identify.arrays import Array
from identify.errors import RecordError
from identify.estimation.base_parameters import structure
from identify.estimation.identifiability import group_rows, identifiability
from identify.estimation.prior import friction, model_guess
from identify.estimation.scale_anchor import MEASURING, default_std, measured_parameter
from identify.model.model_side import ModelSide, model_side
from identify.record.conditions import COMMAND_TIME
from identify.record.delays import MotionLag, ServoDelay, servo_delay
from identify.record.frame_times import GAP, mean_rate
from identify.record.own_record import (
    description_file,
    equal_orders,
    is_log,
    log_suspicions,
    read_description,
    read_telemetry,
)
from identify.record.provenance import recorded_scenario
from identify.record.recording import is_timed, poses, read, recorded_reference
from identify.record.smoothness import Spectrum, pose_noise, spectrum, wrong_poses
from identify.record.suspicions import lag_of, suspicions
from identify.record.telemetry import CommandLog, PoseLog, ReferenceLog, Rows, Telemetry
from identify.scenario.sections import Identification

# Ratio of the number of command rows to that of pose rows above which rows repeat commands.
ONCE = 1.5
MOST_FRAMES = 10_000  # largest number of frames for which the model runs


@dataclass(frozen=True)
class LoggedRun:
    """Telemetry, and what its experimenter states about it.

    telemetry     Poses and commands.
    side          Robot and loop as the estimator knows them.
    settings      Settings of the identification: its prior and its scale anchor.
    stated (6,)   Stated standard deviations of a measured pose, m and rad. None if none are stated.
    suspicions    Likely errors in the units, frames and joints.
    equal_orders  Other orders of Euler angles with which the log fits as well.
    """

    telemetry: Telemetry
    side: ModelSide
    settings: Identification
    stated: Array | None
    suspicions: tuple[str, ...]
    equal_orders: tuple[str, ...] = ()

    @property
    def time(self) -> Array:
        """Times (K,) of the measured poses, s."""
        return self.telemetry.poses.time[self.telemetry.poses.ok]

    @property
    def poses(self) -> Array:
        """Measured poses (K, 6), m and rad, without lost ones."""
        return self.telemetry.poses.pose[self.telemetry.poses.ok]

    @cached_property
    def noise(self) -> Array:
        """Standard deviation (6,) of the noise of the poses, m and rad."""
        return pose_noise(self.time, self.poses)

    @cached_property
    def jumps(self) -> Array:
        """Times (J,) of the poses that reading the record would leave out as gross errors, s."""
        log = self.telemetry.poses
        std = self.noise if self.stated is None else self.stated
        covariance = np.diag(std**2)
        if log.covariance is not None:
            covariance = log.covariance[log.ok].mean(axis=0)
        return log.time[wrong_poses(log, covariance)]

    @cached_property
    def spectrum(self) -> Spectrum:
        """Spectrum of the poses."""
        return spectrum(self.time, self.poses, np.nan_to_num(self.noise))

    @cached_property
    def lag(self) -> MotionLag:
        """Lag of the measured motion behind the commands."""
        return lag_of(self.telemetry, self.side.robot)

    @cached_property
    def delay(self) -> ServoDelay | None:
        """Delay from a pose to its command, or None if the commands show no noise of the poses."""
        return servo_delay(self.telemetry, self.side.robot)

    @property
    def repeats_commands(self) -> bool:
        """True if commands are logged more often than poses, each in several rows."""
        return len(self.telemetry.commands.time) > ONCE * len(self.telemetry.poses.time)

    @cached_property
    def gaps(self) -> Array:
        """Times (G, 2) between which no pose was measured, though one was due, s."""
        between = np.diff(self.time)
        wide = between > GAP * np.median(np.diff(self.telemetry.poses.time))
        return np.stack([self.time[:-1][wide], self.time[1:][wide]], axis=1)

    def commands_at(self, time: Array) -> Array:
        """Return the latest commands (K, n) at times (K,), or the first command if earlier."""
        commands = self.telemetry.commands
        rows = np.searchsorted(commands.time, time, side="right") - 1
        return np.asarray(commands.command[np.maximum(rows, 0)])

    @cached_property
    def grid(self) -> Array:
        """Times (F,), s, of 2 to MOST_FRAMES frames one period apart, from the first pose on."""
        timing = self.side.timing
        count = int(np.ptp(self.time) * timing.frame_rate_hz) + 1
        steps = np.arange(max(min(count, MOST_FRAMES), 2))
        return np.asarray(self.time[0] + steps * timing.frame_period_s)

    @cached_property
    def model_run(self) -> ClosedLoopRun | DynamicsError:
        """Run of the guessed model under the logged commands, or the error with which it fails."""
        robot = self.side.robot
        first = robot.pose(robot.coordinates(self.poses[0]))
        reference = Reference(np.tile(first, (len(self.grid), 1)), np.zeros((len(self.grid), 6)))
        guess = model_guess(robot, self.side.model, self.settings)
        sizes = identifiability(guess, robot).sizes
        bare = friction(robot.layout) & (guess.values == 0)
        ordinary = np.where(bare, sizes, guess.values)
        try:
            return closed_loop.differentiate_commands(
                robot, ordinary, reference, self.side.settings, self.commands_at(self.grid)
            )
        except DynamicsError as error:
            return error

    def commands_change(self, begin: float, end: float) -> bool:
        """Return whether commands differ between two times, without half a frame at both ends."""
        commands = self.telemetry.commands
        period = self.side.timing.frame_period_s
        inside = (commands.time > begin + period / 2) & (commands.time < end - period / 2)
        held = self.commands_at(np.array([begin + period / 2]))
        return bool((commands.command[inside] != held).any())

    def commands_are_missing(self, begin: float, end: float) -> bool:
        """Return whether the command changed between two times without a row between them."""
        commands = self.telemetry.commands
        half = self.side.timing.frame_period_s / 2
        if ((commands.time > begin + half) & (commands.time < end - half)).any():
            return False
        before, after = self.commands_at(np.array([begin + half, end + half]))
        return not np.array_equal(before, after)

    def can_show(self, run: ClosedLoopRun) -> NDArray[np.bool_]:
        """Return which groups (rank,) the poses can identify, as an identification judges them."""
        robot = self.side.robot
        guess = model_guess(robot, self.side.model, self.settings)
        std = self.noise if self.stated is None else self.stated
        assert run.pose_sensitivity is not None
        # Only frames near a measured pose count.
        near = np.searchsorted(self.grid, self.time).clip(0, len(run.pose_sensitivity) - 1)
        rows = run.pose_sensitivity[np.unique(near)] / std[:, None]
        scaled = rows.reshape(-1, len(guess.std)) * guess.std
        information = scaled.T @ scaled + np.eye(len(guess.std))
        anchor = self.settings.scale_anchor
        if anchor in MEASURING:
            number = robot.layout.names.index(measured_parameter(anchor, robot.layout))
            known = self.settings.anchor_std or default_std(anchor, robot.layout)
            information[number, number] += (guess.std[number] / known) ** 2
        covariance = np.linalg.inv(information) * np.outer(guess.std, guess.std)
        rows_of_groups = group_rows(structure(robot).combinations, robot.layout)
        return identifiability(guess, robot).judge(rows_of_groups, covariance)


def read_logged_run(path: Path) -> LoggedRun:
    """Read a record, and what its description or its scenario states about it.

    Raises the errors of `read_own_records`, but accepts any motion, and any clock in a possible
    unit.
    """
    if is_log(path):
        about = read_description(description_file(path), path)
        scenario = about.scenario
        robot = load_robot(scenario.robot)
        telemetry = read_telemetry(path, about, robot)
        _check_unit_of_times(telemetry.poses.time, scenario.timing.frame_rate_hz, path)
        suspected = log_suspicions(path, about, telemetry, robot)
        orders = [] if suspected else equal_orders(path, about, telemetry, robot)
        measured = about.measured
        stds = [measured.position_std_m, measured.orientation_std_rad]
        stated = None if None in stds else np.repeat(np.array(stds, dtype=float), 3)
    else:
        record = read(path)
        scenario = recorded_scenario(record)
        robot = load_robot(scenario.robot)
        telemetry = recorded_telemetry(record, str(path))
        _check_unit_of_times(telemetry.poses.time, scenario.timing.frame_rate_hz, path)
        suspected = suspicions(telemetry, robot)
        orders = []
        stated = None
    if telemetry.poses.covariance is not None:
        covariance = telemetry.poses.covariance[telemetry.poses.ok]
        stated = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))
    return LoggedRun(
        telemetry,
        model_side(robot, scenario),
        scenario.identification,
        stated,
        tuple(suspected),
        tuple(orders),
    )


def _check_unit_of_times(times: Array, rate_hz: float, path: Path) -> None:
    """Raise RecordError if rows are nearer to a power of 1000 frames apart than to one frame.

    The checks of such a record would take hours, and tell nothing.
    """
    if len(times) < 2:
        return
    rate = mean_rate(times)
    powers = round(np.log10(rate / rate_hz) / 3)
    if powers:
        raise RecordError(
            f"{path}: rows of poses are {1 / rate:.3g} s apart, and frames of "
            f"timing.frame_rate_hz = {rate_hz:g} are {1 / rate_hz:.3g} s apart: the unit of the "
            f"times seems wrong by a factor of {1000 ** abs(powers):g}; tables state it by "
            "time_unit in [columns]"
        )


def recorded_telemetry(record: xr.Dataset, source: str) -> Telemetry:
    """Return the logs of a record. `source` names it in messages."""
    time = np.asarray(record["time"].values, dtype=float)
    rows = Rows(source, range(len(time)), "frame")
    ok = record["measured_ok"].values.astype(bool)
    covariance = record["measured_covariance"].values
    log = PoseLog(time, poses(record, "measured"), ok, rows, covariance)
    commands = np.asarray(record["command"].values, dtype=float)
    if is_timed(record):
        acting = np.asarray(record["acting"].values, dtype=float)
        of_commands = Rows(source, range(len(acting)), "command")
        return Telemetry(log, CommandLog(acting, commands, of_commands, acting))
    reference = recorded_reference(record)
    written = record[COMMAND_TIME].values if COMMAND_TIME in record else None
    return Telemetry(
        log,
        CommandLog(time, commands, rows, written),
        ReferenceLog(time, reference.poses, rows, reference.rates),
    )
