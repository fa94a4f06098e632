"""Conditions of a run that its record states in addition to the data of its frames.

Law. A model can simulate the closed loop only with the visual servo. For another control law, the
record states the name of the law, and whether its commands are joint commands or torques. A record
without this information was made with the servo.

Times of commands. A command acts from the instant at which it is written to the drives. If the
latency jitters, a model in which each command has the mean latency is a different loop. If a record
does not hold the times of its commands, the model uses the latency of the timing. The times are
readings of one clock. They do not show the error of the stated mean latency
(`timing.latency_std_s`).

Drift. The drift watch reports whether the cameras drifted during the run.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from dynamics.closed_loop import Drives
from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.files.dataset import Variables, check_variables
from identify.scenario.timing import Timing

SERVO = "pid"  # name of the visual servo's law
TORQUE_UNITS = {"rad": "N m", "m": "N"}  # unit of torque commands, by the unit of joint commands


def store_law(record: xr.Dataset, law: str, drives: Drives) -> None:
    """Store a record's control law, and whether its commands are torques, with the record."""
    record.attrs |= {"law": law, "torque_commands": np.int8(drives.torques)}
    said = record["command"].attrs
    units = TORQUE_UNITS[said["units"]] if drives.torques else said["units"]
    what = "torque" if drives.torques else "joint command"
    said |= {"units": units, "long_name": f"{what} of the law {law} from this frame on"}


def recorded_law(record: xr.Dataset) -> str:
    """Return the name of a record's law. Raises RecordError if the attribute is not a name."""
    law = record.attrs.get("law", SERVO)
    if not isinstance(law, str) or not law:
        raise RecordError(
            f"the record's attribute law is {law!r}, must be the name of the law, or absent for "
            "the servo"
        )
    return law


def takes_torques(record: xr.Dataset) -> bool:
    """Return whether a record's commands are torques. Raises RecordError for an invalid mark."""
    said = record.attrs.get("torque_commands", 0)
    if said not in (0, 1):
        raise RecordError(f"the record's attribute torque_commands is {said!r}, must be 0 or 1")
    return bool(said)


COMMAND_TIME = "command_time"

# Optional variables of a record.
OPTIONAL: Variables = {
    COMMAND_TIME: (
        ("time",),
        "s",
        "time at which the command of this frame acted; NaN if the frame was lost and no command "
        "was written. Without this variable all commands have the latency of the timing",
    )
}

CLOCK_S = 1e-6  # largest difference, s, of two readings of a clock that counts as rounding
SAME_S = 1e-9  # difference, s, below which latencies are the same


def check_command_times(record: xr.Dataset, source: str) -> None:
    """Refuse times of commands that are impossible.

    Raises RecordError with the first frame that has such a time.
    """
    if COMMAND_TIME not in record:
        return
    check_variables(record, OPTIONAL, source)
    acted = record[COMMAND_TIME].values
    lost = record["measured_ok"].values == 0
    time = record["time"].values
    unsaid = np.flatnonzero(~(np.isfinite(acted) | np.isnan(acted) & lost))
    early = np.flatnonzero(acted < time - CLOCK_S)
    # Lost frames without a command are skipped.
    written = np.flatnonzero(~np.isnan(acted))
    back = written[1:][np.diff(acted[written]) < -CLOCK_S]
    overtaken = (
        "is before that of an earlier frame: if a later command arrives first, the earlier command "
        "must have the same time"
    )
    for frames, what in (
        (unsaid, "is not finite, although the frame was measured"),
        (
            early,
            "is before the frame itself, which only another clock explains, and "
            "timing.clock_offset_std_s states its offset",
        ),
        (back, overtaken),
    ):
        if len(frames):
            more = f"; the same in {len(frames)} frames" if len(frames) > 1 else ""
            raise RecordError(
                f"{source}: {COMMAND_TIME} of frame {frames[0]} (t = {time[frames[0]]:.6g} s) is "
                f"{acted[frames[0]]:.6g} s; it {what}{more}"
            )


def command_time_warnings(records: Sequence[xr.Dataset], timing: Timing) -> tuple[str, ...]:
    """Return a warning if the latency jitters and a record lacks the times of its commands."""
    if not timing.latency_jitter_s or all(COMMAND_TIME in record for record in records):
        return ()
    return (
        f"the latency varies by {1e3 * timing.latency_jitter_s:.3g} ms from frame to frame, and a "
        f"record does not state when its commands acted ({COMMAND_TIME}): the model uses the mean "
        "latency for all commands, which is a different loop",
    )


def logged_latencies(record: xr.Dataset, timing: Timing) -> Array | None:
    """Return the logged latency of each frame's command (N,) in s.

    Returns None if the record does not hold the times of its commands, or if all commands have the
    latency of the timing. Raises EstimationError for a latency of more than MAX_DELAY_FRAMES
    frames, which a loop cannot have.
    """
    if COMMAND_TIME not in record:
        return None
    found = record[COMMAND_TIME].values - record["time"].values
    # Lost frames without a command get the latency of the timing.
    latencies: Array = np.where(np.isnan(found), timing.latency_s, np.maximum(found, 0.0))
    in_frames = latencies * timing.frame_rate_hz
    if (in_frames > MAX_DELAY_FRAMES).any():
        first = int(np.argmax(in_frames > MAX_DELAY_FRAMES))
        time = float(record["time"].values[first])
        raise EstimationError(
            f"the command of frame {first} (t = {time:.6g} s) acted {latencies[first]:.4g} s after "
            f"it, {in_frames[first]:.1f} frames of {timing.frame_rate_hz:g} Hz; at most "
            f"{MAX_DELAY_FRAMES} frames are possible"
        )
    return None if np.abs(latencies - timing.latency_s).max() <= SAME_S else latencies


DRIFT = "drift_watch"  # name of the attribute of a record, and of the entry of `result.json`


def store_finding(record: xr.Dataset, finding: Mapping[str, Any]) -> None:
    """Store a finding of the sensor's drift watch with a record."""
    record.attrs[DRIFT] = json.dumps(dict(finding))


def read_finding(record: xr.Dataset) -> dict[str, Any] | None:
    """Return the finding that a record holds, or None if there was no drift watch.

    Raises RecordError if the attribute is not a finding.
    """
    if DRIFT not in record.attrs:
        return None
    try:
        finding = json.loads(record.attrs[DRIFT])
        _ = finding["warning"]
    except (TypeError, ValueError, KeyError) as error:
        raise RecordError(
            f"{DRIFT} of the record is not a finding: {type(error).__name__} {error}"
        ) from None
    return dict(finding)


def drift_warnings(records: Sequence[xr.Dataset]) -> tuple[str, ...]:
    """Return the warnings in the findings of records. Raises the RecordError of `read_finding`."""
    findings = [read_finding(record) for record in records]
    return tuple(
        found["warning"] for found in findings if found is not None and found["warning"] is not None
    )
