"""Which joint command acts when: the commands issued at the frames arrive after latencies, each after its own.

Commands keep their order. One that would overtake the one before it waits and arrives with that one; of commands that
arrive together only the last acts. With the linear hold a command ramps from the one before it over one frame and then
stays; one that arrives before that ramp has ended starts where it would have ended.
"""

from functools import lru_cache
from itertools import accumulate
from math import ceil, floor
from typing import NamedTuple

import numpy as np

from dynamics.closed_loop.problem import LoopProblem

Instant = tuple[int, float]
"""Frame, and time since that frame in s, less than a frame: so the spans of equal delays are equal in all frames."""


class CommandSchedule(NamedTuple):
    """Spans of time in which one command acts, none longer than to the end of its frame.

    Those of frame k are first[k] to first[k + 1]; per span: command, the number of the frame that issued it
    (negative: before the start); ramp, the share of the way from the command before that is done as the span begins
    (1: all of it); duration, s; steps of integration.
    """

    first: np.ndarray
    command: np.ndarray
    ramp: np.ndarray
    duration: np.ndarray
    steps: np.ndarray


def command_schedule(problem: LoopProblem) -> CommandSchedule:
    """The spans of a run; commands issued before it have the latencies of its start, or that of its timing."""
    timing, latencies, before = problem.settings.timing, problem.latencies, problem.start.latencies
    each = None if latencies is None else tuple(latencies.tolist())
    earlier = (float(timing.latency_s),) if before is None else tuple(before.tolist())
    linear, steps = timing.hold == "linear", problem.settings.steps_per_frame
    return _schedule(problem.frames, problem.period, float(timing.latency_s), earlier, each, linear, steps)


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
    oldest = -max(whole for whole, _ in earlier) - 2
    delays = [earlier[max(0, len(earlier) + n)] for n in range(oldest, 0)]
    delays += [_delay(latency, period)] * frames if latencies is None else [_delay(s, period) for s in latencies]
    arrivals = list(accumulate(((oldest + n + whole, rest) for n, (whole, rest) in enumerate(delays)), max))
    ramp_ends = [(frame + 1, rest) for frame, rest in arrivals] if linear else []
    begins = sorted({(k, 0.0) for k in range(frames)} | {i for i in arrivals + ramp_ends if 0 <= i[0] < frames})
    command, ramp, duration = [], [], []
    newest = 0
    for begin, end in zip(begins, [*begins[1:], (frames, 0.0)], strict=True):
        while newest + 1 < len(arrivals) and arrivals[newest + 1] <= begin:
            newest += 1
        command.append(oldest + newest)
        arrived = arrivals[newest]
        under_way = linear and begin < (arrived[0] + 1, arrived[1])
        since = (begin[0] - arrived[0]) * period + (begin[1] - arrived[1])
        ramp.append(since / period if under_way else 1.0)
        duration.append(period - begin[1] if end[0] > begin[0] else end[1] - begin[1])
    return CommandSchedule(
        first=_fixed(np.searchsorted([frame for frame, _ in begins], np.arange(frames + 1)), np.intc),
        command=_fixed(command, np.intc),
        ramp=_fixed(ramp, float),
        duration=_fixed(duration, float),
        steps=_fixed([max(1, ceil(s / period * steps_per_frame - 1e-9)) for s in duration], np.intc),
    )


def _delay(latency: float, period: float) -> Instant:
    """A latency, s, as whole frames and the rest in s, rounded so that what arrives together has equal instants."""
    whole = floor(latency / period + 1e-9)
    return whole, max(0.0, round(latency - whole * period, 13))


def _fixed(values: object, kind: type) -> np.ndarray:
    array: np.ndarray = np.array(values, dtype=kind)
    array.setflags(write=False)
    return array
