"""Schedule of the joint commands: each is issued at its frame and arrives after a latency.

Commands keep their order. A command that would overtake the one before it waits and arrives with
that one. Of commands that arrive together, only the last acts. With the linear hold, a command
ramps over one frame from the command before it, and then stays. A command that arrives before that
ramp has ended starts where the ramp would have ended.
"""

from functools import lru_cache
from itertools import accumulate
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np

from dynamics.closed_loop.problem import LoopProblem

Instant = tuple[int, float]
"""Frame, and time since that frame, s. Equal delays thus give equal spans in all frames."""


class CommandSchedule(NamedTuple):
    """Spans of time in which one command acts. No span is longer than to the end of its frame.

    The spans of frame k are first[k] to first[k + 1]. The other arrays have one entry a span.
    `command` is the number of the frame that issued the command, negative before the start. `ramp`
    is the share of the way from the command before that is done as the span begins, 1 for all of
    it. `duration` is in s, and `steps` is the number of integration steps.
    """

    first: np.ndarray
    command: np.ndarray
    ramp: np.ndarray
    duration: np.ndarray
    steps: np.ndarray


def command_schedule(problem: LoopProblem) -> CommandSchedule:
    """Spans of a run.

    Commands that were issued before the run have the latencies of its start, or that of its timing.
    """
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
    # so far back, a command that was issued before the run may still be on its way
    oldest = -max(whole for whole, _ in earlier) - 2
    delays = [earlier[max(0, len(earlier) + n)] for n in range(oldest, 0)]
    delays += (
        [_delay(latency, period)] * frames
        if latencies is None
        else [_delay(s, period) for s in latencies]
    )
    issued = enumerate(delays, oldest)
    arrivals = _in_order([(frame + whole, rest) for frame, (whole, rest) in issued])
    ramp_ends = [(frame + 1, rest) for frame, rest in arrivals] if linear else []
    # spans begin at frames, where the pose is measured, and where the command changes its course
    begins = sorted(
        {(k, 0.0) for k in range(frames)} | {i for i in arrivals + ramp_ends if 0 <= i[0] < frames}
    )
    command = []
    ramp = []
    duration = []
    newest = 0
    for begin, end in zip(begins, [*begins[1:], (frames, 0.0)], strict=True):
        # of commands that arrive together only the last one acts
        while newest + 1 < len(arrivals) and arrivals[newest + 1] <= begin:
            newest += 1
        command.append(oldest + newest)
        arrived = arrivals[newest]
        under_way = linear and begin < (arrived[0] + 1, arrived[1])
        since = (begin[0] - arrived[0]) * period + (begin[1] - arrived[1])
        ramp.append(since / period if under_way else 1.0)
        # a span to the end of its frame gets the rest of the period, so that all add up to it
        duration.append(period - begin[1] if end[0] > begin[0] else end[1] - begin[1])
    return CommandSchedule(
        first=_fixed(
            np.searchsorted([frame for frame, _ in begins], np.arange(frames + 1)), np.intc
        ),
        command=_fixed(command, np.intc),
        ramp=_fixed(ramp, float),
        duration=_fixed(duration, float),
        steps=_fixed(
            [max(1, ceil(s / period * steps_per_frame - 1e-9)) for s in duration], np.intc
        ),
    )


def acting_times(issued: np.ndarray, latencies: np.ndarray) -> np.ndarray:
    """Times (frames,), s, at which commands act that are issued at given times (frames,), s."""
    return np.array(_in_order((issued + latencies).tolist()), dtype=float)


def _in_order(arrivals: list[Any]) -> list[Any]:
    """Arrivals of commands, none of which is before that of the command before it."""
    return list(accumulate(arrivals, max))


def _delay(latency: float, period: float) -> Instant:
    """Latency, s, as whole frames and a rest in s.

    The rest is rounded, so that commands that arrive together have equal instants.
    """
    whole = floor(latency / period + 1e-9)
    return whole, max(0.0, round(latency - whole * period, 13))


def _fixed(values: object, kind: type) -> np.ndarray:
    array: np.ndarray = np.array(values, dtype=kind)
    array.setflags(write=False)
    return array
