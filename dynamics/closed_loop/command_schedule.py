"""Schedule of the joint commands: each is issued at its frame and arrives after a latency.

Commands keep their order. A command that would overtake an earlier one waits, and arrives together
with it. If several commands arrive together, only the one issued last acts. With the linear hold, a
command ramps from the value of the command issued before it over one frame period, and then remains
constant. If the ramp of that earlier command has not ended, the new ramp begins with a jump.
"""

from functools import lru_cache
from itertools import accumulate
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np

from dynamics.closed_loop.problem import LoopProblem

# Frame, and time since that frame, s. Times are kept in this form so that equal delays give exactly
# equal spans in all frames.
Instant = tuple[int, float]


class CommandSchedule(NamedTuple):
    """Spans of time in which one command acts. A span does not go beyond the end of its frame.

    The spans of frame k have the indices first[k] to first[k + 1] - 1. The other arrays have one
    entry per span. `command` is the number of the frame that issued the command; it is negative
    before the start. `ramp` is the fraction of the ramp that is done when the span begins. If it is
    1, the command is constant. `duration` is in s, and `steps` is the number of integration steps.
    """

    first: np.ndarray
    command: np.ndarray
    ramp: np.ndarray
    duration: np.ndarray
    steps: np.ndarray


def command_schedule(problem: LoopProblem) -> CommandSchedule:
    """Schedule of a run.

    Commands issued before the run have the latencies of the start state, or the latency of
    `FrameTiming` if the start state has none.
    """
    if problem.times is not None:
        return _schedule_at_times(problem)
    timing = problem.settings.timing
    latencies = problem.latencies
    before = problem.start.latencies
    each = None if latencies is None else tuple(latencies.tolist())
    earlier = (float(timing.latency_s),) if before is None else tuple(before.tolist())
    linear = timing.hold == "linear"
    steps = problem.settings.steps_per_frame
    return _schedule(
        problem.frames, problem.period, float(timing.latency_s), earlier, each, linear, steps
    )


@lru_cache(maxsize=32)
def _schedule(
    frames: int,
    period: float,
    latency: float,
    before: tuple[float, ...],
    latencies: tuple[float, ...] | None,
    linear: bool,
    steps_per_frame: int,
) -> CommandSchedule:
    earlier = [_delay(s, period) for s in before]
    # the oldest command is so old that it arrives before the run, and its ramp ends before the run
    oldest = -max(delay_frames for delay_frames, _ in earlier) - 2
    delays = [earlier[max(0, len(earlier) + n)] for n in range(oldest, 0)]
    delays += (
        [_delay(latency, period)] * frames
        if latencies is None
        else [_delay(s, period) for s in latencies]
    )
    issued = enumerate(delays, oldest)
    arrivals = _in_order([(frame + late, rest) for frame, (late, rest) in issued])
    ramp_ends = [(frame + 1, rest) for frame, rest in arrivals] if linear else []
    # spans begin at frames, at arrivals of commands, and at ends of ramps
    begins = sorted(
        {(k, 0.0) for k in range(frames)} | {i for i in arrivals + ramp_ends if 0 <= i[0] < frames}
    )
    command = []
    ramp = []
    duration = []
    newest = 0
    for begin, end in zip(begins, [*begins[1:], (frames, 0.0)], strict=True):
        # if several commands arrive together, only the one issued last acts
        while newest + 1 < len(arrivals) and arrivals[newest + 1] <= begin:
            newest += 1
        command.append(oldest + newest)
        arrived = arrivals[newest]
        under_way = linear and begin < (arrived[0] + 1, arrived[1])
        since = (begin[0] - arrived[0]) * period + (begin[1] - arrived[1])
        ramp.append(since / period if under_way else 1.0)
        # the last span of a frame is the rest of the period, so that spans add up to one period
        duration.append(period - begin[1] if end[0] > begin[0] else end[1] - begin[1])
    return CommandSchedule(
        first=_fixed(
            np.searchsorted([frame for frame, _ in begins], np.arange(frames + 1)), np.intc
        ),
        command=_fixed(command, np.intc),
        ramp=_fixed(ramp, float),
        duration=_fixed(duration, float),
        steps=_fixed(
            # the small number keeps rounding errors from adding a step
            [max(1, ceil(s / period * steps_per_frame - 1e-9)) for s in duration],
            np.intc,
        ),
    )


# Instants that differ by at most this time, s, count as one in a run with given `times`.
SAME_S = 1e-9


def _schedule_at_times(problem: LoopProblem) -> CommandSchedule:
    """Schedule of a run whose frames are at given times.

    It is assumed that commands from before the run were issued one period apart, the newest of them
    one period before the first frame.
    """
    timing = problem.settings.timing
    times = problem.frame_times
    assert problem.written is not None
    period = problem.period
    start_latencies = problem.start.latencies
    before = np.array([timing.latency_s]) if start_latencies is None else start_latencies
    late = np.full(len(times), timing.latency_s) if problem.latencies is None else problem.latencies
    # the oldest command from before the run also stands for all earlier ones
    old_numbers = np.arange(-len(before), 0)
    new_numbers = np.flatnonzero(problem.written)
    numbers = np.concatenate([old_numbers, new_numbers])
    issued = np.concatenate([times[0] + old_numbers * period, times[new_numbers]])
    arrivals = acting_times(issued, np.concatenate([before, late[new_numbers]]))
    nearest = np.clip(np.searchsorted(times, arrivals - SAME_S), 0, len(times) - 1)
    at_frame = np.abs(times[nearest] - arrivals) <= SAME_S
    arrivals = np.where(at_frame, times[nearest], arrivals)
    linear = timing.hold == "linear"
    inside = np.concatenate([arrivals, arrivals + period] if linear else [arrivals])
    inside = inside[(inside > times[0]) & (inside < times[-1])]
    begins = np.unique(np.concatenate([times, inside]))
    # an instant that the next one follows within SAME_S begins no span, unless it is a frame
    kept = np.append(np.diff(begins) > SAME_S, True) | np.isin(begins, times)
    begins = begins[kept]
    newest = np.maximum(np.searchsorted(arrivals, begins, side="right") - 1, 0)
    since = np.maximum(begins - arrivals[newest], 0.0)
    under_way = linear & (since < period - SAME_S)
    duration = np.diff(begins, append=begins[-1] + period)
    steps = np.ceil(duration / period * problem.settings.steps_per_frame - 1e-9)
    return CommandSchedule(
        first=_fixed(np.append(np.searchsorted(begins, times), len(begins)), np.intc),
        command=_fixed(numbers[newest], np.intc),
        ramp=_fixed(np.where(under_way, since / period, 1.0), float),
        duration=_fixed(duration, float),
        steps=_fixed(np.maximum(steps, 1), np.intc),
    )


def acting_times(issued: np.ndarray, latencies: np.ndarray) -> np.ndarray:
    """Times (N,) at which commands begin to act, in the unit of their times of issue (N,).

    No command acts before an earlier one. The unit of `latencies` (N,) is the same.
    """
    return np.array(_in_order((issued + latencies).tolist()), dtype=float)


def _in_order(arrivals: list[Any]) -> list[Any]:
    """Arrivals of commands, delayed where needed so that none is before the previous one."""
    return list(accumulate(arrivals, max))


def _delay(latency: float, period: float) -> Instant:
    """Latency, s, as a number of whole frames and a remainder, s.

    The remainder is rounded, so that commands that arrive together have equal instants.
    """
    frames = floor(latency / period + 1e-9)
    return frames, max(0.0, round(latency - frames * period, 13))


def _fixed(values: object, kind: type) -> np.ndarray:
    """Values as a read-only array."""
    array: np.ndarray = np.array(values, dtype=kind)
    array.setflags(write=False)
    return array
