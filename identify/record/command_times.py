"""When the command of each frame acted, as a laboratory logs it: the instant at which it was
written to the drives.

A latency that jitters takes every command at another time, and a model that takes the mean for all
of them is another loop. Of a record that says nothing of it the model's commands have the latency
of the timing. The log is a clock's: how far the mean latency is from what is stated
(`timing.latency_std_s`), it does not know either.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from dynamics.closed_loop.loop_settings import (
    MAX_DELAY_FRAMES,
)
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
        "was written. Without "
        "this variable all commands have the latency of the timing",
    )
}
"""What a record may hold beside its other variables."""

CLOCK_S = 1e-6
"""s, by which two clock readings of the same instant may differ."""

SAME_S = 1e-9
"""s: latencies that differ by less are the same."""


def check_command_times(record: xr.Dataset, source: str) -> None:
    """Refuse times of commands that cannot be. Raises RecordError, with the first frame of which
    that is so.
    """
    if COMMAND_TIME not in record:
        return
    check_variables(record, OPTIONAL, source)
    acted = record[COMMAND_TIME].values
    lost = record["measured_ok"].values == 0
    time = record["time"].values
    written = np.flatnonzero(~np.isnan(acted))
    early = np.flatnonzero(acted < time - CLOCK_S)
    back = written[1:][np.diff(acted[written]) < -CLOCK_S]
    for frames, what in (
        (
            np.flatnonzero(~(np.isfinite(acted) | np.isnan(acted) & lost)),
            "is not finite, and that frame was measured",
        ),
        (early, "is before the frame itself, which its command answers"),
        (
            back,
            "is before that of an earlier frame: a command that was overtaken acts with the one "
            "that overtook it",
        ),
    ):
        if len(frames):
            raise RecordError(
                f"{source}: {COMMAND_TIME} of frame {frames[0]} (t = {time[frames[0]]:.6g} s) is "
                f"{acted[frames[0]]:.6g} s; it {what}"
                + (f"; so in {len(frames)} frames" if len(frames) > 1 else "")
            )


def command_time_warnings(records: Sequence[xr.Dataset], timing: Timing) -> tuple[str, ...]:
    """One line where a latency jitters, and a record does not say when its commands acted."""
    if not timing.latency_jitter_s or all(COMMAND_TIME in record for record in records):
        return ()
    return (
        f"the latency varies by {1e3 * timing.latency_jitter_s:.3g} ms from frame to frame, and a "
        "record does not say "
        f"when its commands acted ({COMMAND_TIME}): the model takes the mean for all, and is "
        "another loop",
    )


def logged_latencies(record: xr.Dataset, timing: Timing) -> Array | None:
    """Latency of each frame's command (N,) in s, as logged; None where all have that of the timing.

    Raises EstimationError: one that is longer than a loop can have.
    """
    if COMMAND_TIME not in record:
        return None
    found = record[COMMAND_TIME].values - record["time"].values
    latencies: Array = np.where(np.isnan(found), timing.latency_s, np.maximum(found, 0.0))
    in_frames = latencies * timing.frame_rate_hz
    if (in_frames > MAX_DELAY_FRAMES).any():
        first = int(np.argmax(in_frames > MAX_DELAY_FRAMES))
        raise EstimationError(
            f"the command of frame {first} acted {latencies[first]:.4g} s after it, "
            f"{in_frames[first]:.1f} frames of "
            f"{timing.frame_rate_hz:g} Hz; at most {MAX_DELAY_FRAMES} frames are possible"
        )
    return None if np.abs(latencies - timing.latency_s).max() <= SAME_S else latencies
