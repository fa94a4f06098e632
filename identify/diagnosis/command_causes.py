"""Causes between the log of the commands and the drives: errors of scale and of clocks.

A record with commands at its frames states a latency for each of them. A record with commands at
any times states when each of them acts.
"""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.diagnosis.cause import Cause, OnCommands, in_each_run, prior_std
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.model.timed_model import TimedModel

CLOCK_STEP_S = 1e-4  # change of a latency for differences
SHORTEST_S = 1e-4  # lower limit of the time between two commands in `delayed`
SCALE_STD = 1e-3  # standard deviation of the scale of commands in an ordinary workshop
SCALE_STEP = 1e-4  # change of the scale of commands for differences


def command_causes(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the causes between log and drives that a problem can have."""
    return (*scales(), *clocks(problem))


def scales() -> tuple[Cause, ...]:
    """Return the error of the commands' scale about the zeros of the joints."""

    def scaled(run: LoopModel, size: float) -> LoopModel:
        return replace(run, logged=(1.0 + size) * run.logged)

    return (
        Cause(
            name="scale of the commands",
            unit="1",
            group="scale of the commands",
            change=in_each_run(scaled),
            step=SCALE_STEP,
            effect=OnCommands(lambda run, place: run.logged),
            exact=True,
            remedy=lambda size: (
                f"--set model.command_scale_std={prior_std(size, SCALE_STD):g}, or mend the ratio "
                "of the gears or the encoders"
            ),
        ),
    )


def clocks(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return offset and drift of the commands' clock, positive if commands act later."""
    timing = problem.runs[0].settings.timing

    def drifting(run: LoopModel, size: float) -> LoopModel:
        return acting_later(run, size * seconds_of(run))

    def remedied(size: float) -> str:
        when = f"{1e3 * abs(size):.3g} ms {'later' if size > 0 else 'earlier'}"
        if timed:
            return (
                f"the commands act {when} than their times say: state timing.clock_offset_std_s, "
                "or correct these times"
            )
        return (
            f"state timing.latency_s = {timing.latency_s + size:.6g} with the record: the commands "
            f"act {when} than it says"
        )

    timed = any(isinstance(run, TimedModel) for run in problem.runs)
    # the offset of a clock has no limit, but a latency cannot be negative
    earliest = np.inf if timed else min(float(run.stated_latencies.min()) for run in problem.runs)
    longest = max(float(seconds_of(run)[-1]) for run in problem.runs)
    return (
        Cause(
            name="latency of the commands",
            unit="s",
            group="latency of the commands",
            change=in_each_run(acting_later),
            step=CLOCK_STEP_S,
            effect=OnCommands(lambda run, place: delayed(run)),
            exact=True,
            remedy=remedied,
            least=-earliest,
        ),
        Cause(
            name="drift of the commands' clock",
            unit="s/s",
            group="drift of the commands' clock",
            change=in_each_run(drifting),
            step=CLOCK_STEP_S / longest,
            effect=OnCommands(lambda run, place: delayed(run) * seconds_of(run)[:, None]),
            exact=True,
            remedy=lambda size: (
                f"correct the times of the commands by {1e6 * size:.3g} us a second, or give "
                "cameras and drives one clock"
            ),
            least=-earliest / longest,
        ),
    )


def seconds_of(run: LoopModel) -> Array:
    """Return the times (N,), s, of a run's commands, counted from its first frame."""
    if isinstance(run, TimedModel):
        return np.asarray(run.acting - run.times[0])
    return np.arange(len(run.logged)) / run.settings.timing.frame_rate_hz


def acting_later(run: LoopModel, seconds: Array | float) -> LoopModel:
    """Return a model whose commands act later by some seconds (N,). `possible` limits latencies."""
    if isinstance(run, TimedModel):
        return replace(run, acting=run.acting + seconds)
    return replace(run, acted=possible(run, run.stated_latencies + seconds))


def delayed(run: LoopModel) -> Array:
    """Return the derivative (N, n) of the commands with respect to a delay, s.

    If a held command acts later by s, the one before it acts longer by s. This change is at the
    boundary of their two intervals, and each interval gets half of it.
    """
    changes = np.diff(run.logged, axis=0, prepend=run.logged[:1], append=run.logged[-1:])
    rates = np.full((len(run.logged), 1), run.settings.timing.frame_rate_hz)
    if isinstance(run, TimedModel) and len(rates) > 1:
        # commands that act at the same time would divide by zero
        rates[:-1, 0] = 1.0 / np.maximum(np.diff(run.acting), SHORTEST_S)
    return -rates * (changes[:-1] + changes[1:]) / 2


def possible(run: LoopModel, latencies: Array) -> Array:
    """Return latencies (N,) clipped to those that a loop can have, 0 to MAX_DELAY_FRAMES frames."""
    return np.clip(latencies, 0.0, MAX_DELAY_FRAMES / run.settings.timing.frame_rate_hz)
