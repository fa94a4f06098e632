"""Times at which the commands of the frames acted, as a laboratory logs them.

A command acts from the instant at which it is written to the drives. With a latency that jitters,
every command acts after another time, and a model that takes the mean for all of them describes
another loop. If a record holds no such times, the model's commands have the latency of the timing.
The log is that of a clock. It does not show how far the mean latency is from the stated one
(`timing.latency_std_s`).
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.files.dataset import Variables, check_variables
from identify.scenario.timing import Timing

COMMAND_TIME = "command_time"

OPTIONAL: Variables = {
    COMMAND_TIME: (
        ("time",),
        "s",
        "time at which the command of this frame acted; NaN where the frame was lost and nothing "
        "was written. Without this variable all commands have the latency of the timing",
    )
}
"""Variables that a record may hold beside the others."""

CLOCK_S = 1e-6
"""Difference, s, that two clock readings of the same instant may have."""

SAME_S = 1e-9
"""Difference, s, below which latencies are the same."""


def check_command_times(record: xr.Dataset, source: str) -> None:
    """Refuse times of commands that are impossible.

    Raises RecordError with the first frame of that kind.
    """
    if COMMAND_TIME not in record:
        return
    check_variables(record, OPTIONAL, source)
    acted = record[COMMAND_TIME].values
    lost = record["measured_ok"].values == 0
    time = record["time"].values
    unsaid = np.flatnonzero(~(np.isfinite(acted) | np.isnan(acted) & lost))
    early = np.flatnonzero(acted < time - CLOCK_S)
    # lost frames have written nothing, and stand between those that have
    written = np.flatnonzero(~np.isnan(acted))
    back = written[1:][np.diff(acted[written]) < -CLOCK_S]
    overtaken = (
        "is before that of an earlier frame: a command that was overtaken acts with the one that "
        "overtook it"
    )
    for frames, what in (
        (unsaid, "is not finite, and that frame was measured"),
        (early, "is before the frame itself, which its command answers"),
        (back, overtaken),
    ):
        if len(frames):
            more = f"; so in {len(frames)} frames" if len(frames) > 1 else ""
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
        f"record does not say when its commands acted ({COMMAND_TIME}): the model takes the mean "
        "for all, and is another loop",
    )


def logged_latencies(record: xr.Dataset, timing: Timing) -> Array | None:
    """Return the logged latency of each frame's command (N,) in s.

    None if all have that of the timing. Raises EstimationError for one that is longer than a loop
    can have.
    """
    if COMMAND_TIME not in record:
        return None
    found = record[COMMAND_TIME].values - record["time"].values
    # lost frames have written nothing, and get the latency of the timing
    latencies: Array = np.where(np.isnan(found), timing.latency_s, np.maximum(found, 0.0))
    in_frames = latencies * timing.frame_rate_hz
    if (in_frames > MAX_DELAY_FRAMES).any():
        first = int(np.argmax(in_frames > MAX_DELAY_FRAMES))
        raise EstimationError(
            f"the command of frame {first} acted {latencies[first]:.4g} s after it, "
            f"{in_frames[first]:.1f} frames of {timing.frame_rate_hz:g} Hz; at most "
            f"{MAX_DELAY_FRAMES} frames are possible"
        )
    return None if np.abs(latencies - timing.latency_s).max() <= SAME_S else latencies
