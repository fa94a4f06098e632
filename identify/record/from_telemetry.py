"""Record of a run from its logs of poses, commands and the reference.

A log becomes a record on the grid of frames if its rows are on this grid and hold a command each,
if it has a reference and begins at rest, if it shows every pose that the servo used, and if poses
and commands have one clock. The model of such a record can close its own loop. Every other log
becomes a record with times of its own, whose model the commands drive.

Gross errors are left out, and what was decided is noted in the record.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.record.checks import begins_at_rest
from identify.record.frame_times import GAP, frame_grid, likelier_times, mean_rate, missing_rows
from identify.record.lost_pose_marks import repeated_note
from identify.record.recording import build_record
from identify.record.smoothness import wrong_poses
from identify.record.telemetry import TIME_ROUNDING, CommandLog, PoseLog, ReferenceLog, Telemetry
from identify.record.timed_record import build_timed_record
from identify.scenario import Timing

MOST_GROSS = 0.1  # largest fraction of the measured poses that can be gross errors
# Relative difference of the rate of rows from the frame rate above which the log is refused.
OTHER_RATE = 0.05
NAMED = 10  # largest number of gross errors whose times a note names
# Attribute of a record with what was decided when its file was read, as a JSON list.
NOTES = "notes"
# Attributes of a record: number of rows for poses in its log, and of frames without a row there.
LOGGED_ROWS = "logged_rows"
MISSING_ROWS = "missing_rows"


def record_of(
    telemetry: Telemetry, robot: Robot, timing: Timing, scenario_toml: str, stated: Array
) -> xr.Dataset:
    """Return the record of a run from its logs.

    scenario_toml: scenario that the record states. stated (6, 6): covariance of the poses if the
    log holds none. Raises RecordError if more than a tenth of the poses are gross errors, if no
    command is logged, if clocks do not overlap, if rows of one table have another rate than the
    timing, or as `build_record` and `build_timed_record` do.
    """
    ok = telemetry.poses.ok
    covariances = telemetry.poses.covariance
    if covariances is None:
        covariances = np.tile(stated, (len(ok), 1, 1))
    _check_clocks(telemetry)
    wrong, notes = _gross(telemetry.poses, covariances)
    notes += repeated_note(telemetry.poses)
    poses = replace(telemetry.poses, ok=ok & ~wrong, covariance=covariances)
    telemetry = replace(telemetry, poses=poses)
    given: dict[str, Any] = {
        "robot": robot.name,
        "scenario_toml": scenario_toml,
        "frame_rate_hz": timing.frame_rate_hz,
        "prismatic": robot.layout.prismatic,
    }
    why = _not_on_grid(telemetry, timing, has_gross=bool(wrong.any()))
    if why is None:
        assert telemetry.reference is not None
        record = build_record(
            time=poses.time,
            reference_pose=telemetry.reference.pose,
            reference_rate=rates(telemetry.reference, timing.frame_period_s),
            measured_pose=poses.pose,
            measured_covariance=covariances,
            measured_ok=poses.ok,
            command=telemetry.commands.command,
            command_time=telemetry.commands.written,
            **given,
        )
    else:
        times, acting, more = _event_times(telemetry, timing)
        kept = _new_commands(telemetry.commands)
        gaps, held = _gaps(telemetry, acting, kept)
        record = build_timed_record(
            time=times,
            measured_pose=poses.pose,
            measured_covariance=covariances,
            measured_ok=poses.ok,
            acting=acting[kept],
            command=telemetry.commands.command[kept],
            gaps=gaps,
            **given,
        )
        notes += [f"the commands drive the model: {why}", *more, *held]
    missing = missing_rows(poses.time, timing.frame_rate_hz)
    record.attrs |= {LOGGED_ROWS: len(ok), MISSING_ROWS: missing}
    if notes:
        record.attrs[NOTES] = json.dumps(notes)
    return record


def reading_notes(records: Sequence[xr.Dataset]) -> tuple[str, ...]:
    """Return what was decided when the files of records were read.

    Raises RecordError if a note is not text.
    """
    found: list[str] = []
    for record in records:
        text = record.attrs.get(NOTES, "[]")
        try:
            notes = json.loads(text)
        except (TypeError, ValueError):
            notes = None
        if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
            raise RecordError(f"the record's attribute {NOTES} is {text!r}, must be a list of text")
        found += notes
    return tuple(found)


def rates(reference: ReferenceLog, frame_period_s: float) -> Array:
    """Return the rates (N, 6) of a reference, from its log or from a spline through its poses."""
    if reference.rate is not None:
        return reference.rate
    # A record that is too short for a spline is refused later, because of its length.
    if len(reference.pose) < 6:
        return np.zeros_like(reference.pose)
    times = np.arange(len(reference.pose)) * frame_period_s
    spline = make_interp_spline(times, reference.pose, k=5)
    return np.asarray(spline.derivative()(times), dtype=float)


class GrossErrors(RecordError):
    """Error for a log with too many poses that are gross errors.

    log         The log.
    wrong (N,)  True for its poses that are gross errors.
    """

    def __init__(self, message: str, log: PoseLog, wrong: NDArray[np.bool_]) -> None:
        super().__init__(message)
        self.log = log
        self.wrong = wrong


def _gross(log: PoseLog, covariances: Array) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which poses (N,) are gross errors, and a note that names them.

    Raises GrossErrors if there are too many.
    """
    good = int(log.ok.sum())
    wrong = wrong_poses(log, covariances[log.ok].mean(axis=0) if good else covariances[0])
    count = int(wrong.sum())
    if not count:
        return wrong, []
    shown = ", ".join(f"{time:.3f}" for time in log.time[wrong][:NAMED])
    named = f"t = {shown} s" + (f" and {count - NAMED} more" if count > NAMED else "")
    if count > MOST_GROSS * good:
        repeated = "".join(f"; {note}" for note in repeated_note(log))
        raise GrossErrors(
            f"{log.rows.source}: {count} of {good} poses are far from the motion of their "
            f"neighbours, at {named}; at most {MOST_GROSS:.0%} are left out as gross errors"
            f"{repeated}",
            log,
            wrong,
        )
    return wrong, [f"{count} single poses were left out as gross errors: {named}"]


def _check_clocks(telemetry: Telemetry) -> None:
    """Check that commands act while poses are seen. Raises RecordError with the first command."""
    commands = telemetry.commands
    seen = telemetry.poses.time
    acted = commands.time if commands.written is None else commands.written
    rows = np.flatnonzero(np.isfinite(acted))
    if len(rows) and (acted[rows].min() > seen[-1] or acted[rows].max() < seen[0]):
        raise RecordError(
            f"{commands.rows.place(int(rows[0]))}: its command acts {acted[rows[0]]:.9g} s after "
            f"the first pose, the last command {acted[rows].max():.9g} s, and poses are seen for "
            f"{seen[-1]:.6g} s: the clocks do not overlap"
        )


def _not_on_grid(telemetry: Telemetry, timing: Timing, has_gross: bool) -> str | None:
    """Return why a log makes no record on the grid, or None. Raises as `_check_rate` does."""
    reference = telemetry.reference
    poses = telemetry.poses
    if reference is None:
        return "the record holds no reference"
    if not telemetry.is_one_table:
        return "poses and commands were logged at different times"
    frames = np.diff(poses.time) * timing.frame_rate_hz
    _check_rate(telemetry, timing.frame_rate_hz)
    if not (np.abs(frames - 1) <= TIME_ROUNDING).all():
        return "the rows are not one frame period apart"
    if timing.clock_offset_std_s or timing.clock_drift_std:
        return "poses and commands have different clocks"
    if has_gross:
        return "the servo used wrong poses"
    if not np.isfinite(telemetry.commands.command).all():
        return "some rows hold no command"
    if _seen_but_lost(telemetry):
        return (
            "commands change in rows without a measured pose, where the servo saw poses that were "
            "not logged"
        )
    if not begins_at_rest(rates(reference, timing.frame_period_s)):
        return "the record begins in motion"
    return None


def _check_rate(telemetry: Telemetry, rate_hz: float) -> None:
    """Check that the usual time between the rows of one table is one frame of the stated rate.

    Otherwise, raises RecordError with the first row at another distance.
    """
    times = telemetry.poses.time
    if len(times) < 2:
        return
    frames = np.diff(times) * rate_hz
    mean = rate_hz / mean_rate(times)
    if abs(mean - 1) > OTHER_RATE:
        row = int(np.argmax(np.abs(frames - 1) > OTHER_RATE))
        raise RecordError(
            f"{telemetry.poses.rows.place(row + 1)}: time_s is {times[row + 1]:g} after "
            f"{times[row]:g} in the row before, which is {frames[row]:.4g} frames of {rate_hz:g} "
            f"Hz (timing.frame_rate_hz) and not one; on average rows are {mean:.4g} frames apart"
        )


def _seen_but_lost(telemetry: Telemetry) -> bool:
    """Return whether a command changes in a row without a measured pose."""
    command = telemetry.commands.command
    changes = (np.diff(command, axis=0) != 0).any(axis=1)
    return bool((changes & ~telemetry.poses.ok[1:]).any())


def _event_times(telemetry: Telemetry, timing: Timing) -> tuple[Array, Array, list[str]]:
    """Return the times (N,) of poses, the times (M,) at which commands act, s, and notes.

    The times of poses are the logged ones, or frames if these are likelier.
    """
    poses = telemetry.poses
    commands = telemetry.commands
    rate_hz = timing.frame_rate_hz
    times = poses.time
    assert poses.covariance is not None
    good = poses.ok
    notes = []
    grid = frame_grid(times, rate_hz)
    if grid is not None and good.sum() > 30:
        covariance = poses.covariance[good].mean(axis=0)
        found = likelier_times(times[good], poses.pose[good], covariance, rate_hz)
        if not np.array_equal(found, times[good]):
            off = float(np.std(times - grid))
            notes = [
                f"poses are smoother at frames of {1 / np.diff(grid).min():.4f} Hz than at the "
                f"logged times, which differ by {1e3 * off:.2g} ms (rms): the frames were taken"
            ]
            times = grid
    if commands.written is not None:
        acting = commands.written
        if timing.latency_s:
            notes.append(
                f"timing.latency_s = {timing.latency_s:g} does not move the commands, which have "
                "times of their own"
            )
    elif np.array_equal(commands.time, poses.time):
        acting = times + timing.latency_s
    else:
        acting = commands.time + timing.latency_s
    return times, acting, notes


def _new_commands(commands: CommandLog) -> NDArray[np.bool_]:
    """Return which rows (M,) issue a command.

    An empty row issues none. If a logger is faster than the controller, most rows repeat the
    previous command, and only rows with another command issue one. Raises RecordError if no row
    holds a command.
    """
    given = np.array(np.isfinite(commands.command).all(axis=1))
    if commands.written is not None:
        given &= np.isfinite(commands.written)
    if not given.any():
        raise RecordError(f"{commands.rows.source}: no row holds a command")
    rows = np.flatnonzero(given)
    changes = np.append(True, (np.diff(commands.command[rows], axis=0) != 0).any(axis=1))
    if changes.mean() < 0.5:
        given[rows[~changes]] = False
    return given


def _gaps(telemetry: Telemetry, acting: Array, kept: NDArray[np.bool_]) -> tuple[Array, list[str]]:
    """Return the times (k, 2) of the last and the first command around gaps, s, and notes.

    In a gap, rows of commands and of poses are missing, and the commands are unknown. If only rows
    of commands are missing, or if the commands before and after the missing rows are equal, the
    command was held and there is no gap.
    """
    rows = telemetry.commands.time
    poses = telemetry.poses.time
    usual = GAP * max(float(np.median(np.diff(rows))), float(np.median(np.diff(poses))))
    command = telemetry.commands.command
    found = []
    notes = []
    for row in np.flatnonzero(np.diff(rows) > usual):
        inside = (poses > rows[row] + 1e-9) & (poses < rows[row + 1] - 1e-9)
        before = np.flatnonzero(kept[: row + 1])
        after = np.flatnonzero(kept[row + 1 :])
        if inside.any() or not (len(before) and len(after)):
            continue
        if np.array_equal(command[row], command[row + 1]):
            notes.append(
                f"rows are missing from t = {rows[row]:.2f} s to {rows[row + 1]:.2f} s, and the "
                "command after them is the one before: it was held"
            )
        else:
            found.append((acting[before[-1]], acting[row + 1 + after[0]]))
    return np.array(found).reshape(-1, 2), notes
