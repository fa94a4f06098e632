"""Causes between the log of the commands and the drives: their scale, and clocks."""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.diagnosis.cause import Cause, OnCommands, in_each_run, prior_std
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel

CLOCK_STEP_S = 1e-4
"""Change of a latency for differences."""

SCALE_STD = 1e-3
"""Standard deviation of the scale of commands in an ordinary workshop."""

SCALE_STEP = 1e-4
"""Change of the scale of commands for differences."""


def command_causes(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the causes between log and drives that a problem can have."""
    return (*scales(), *clocks(problem))


def scales() -> tuple[Cause, ...]:
    """Return the scale of the commands about the zeros of the joints."""

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
            remedy=lambda size: (
                f"--set model.command_scale_std={prior_std(size, SCALE_STD):g}, or mend the ratio "
                "of the gears or the encoders"
            ),
        ),
    )


def clocks(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the offset and the drift of the clock of the commands against that of the frames."""
    timing = problem.runs[0].settings.timing

    def later(run: LoopModel, size: float) -> LoopModel:
        return replace(run, acted=possible(run, run.stated_latencies + size))

    def drifting(run: LoopModel, size: float) -> LoopModel:
        return replace(run, acted=possible(run, run.stated_latencies + size * seconds_of(run)))

    earliest = min(float(run.stated_latencies.min()) for run in problem.runs)
    longest = max(len(run.ok) for run in problem.runs) / timing.frame_rate_hz
    return (
        Cause(
            name="latency of the commands",
            unit="s",
            group="latency of the commands",
            change=in_each_run(later),
            step=CLOCK_STEP_S,
            effect=OnCommands(lambda run, place: delayed(run)),
            remedy=lambda size: (
                f"state timing.latency_s = {timing.latency_s + size:.6g} with the record: the "
                f"commands act {1e3 * abs(size):.3g} ms {'later' if size > 0 else 'earlier'} than "
                "it says"
            ),
            least=-earliest,
        ),
        Cause(
            name="drift of the commands' clock",
            unit="s/s",
            group="drift of the commands' clock",
            change=in_each_run(drifting),
            step=CLOCK_STEP_S / longest,
            effect=OnCommands(lambda run, place: delayed(run) * seconds_of(run)[:, None]),
            remedy=lambda size: (
                f"correct the times of the commands by {1e6 * size:.3g} us a second, or give "
                "cameras and drives one clock"
            ),
            least=-earliest / longest,
        ),
    )


def seconds_of(run: LoopModel) -> Array:
    """Return the times (N,) of the frames of a run, s."""
    return np.arange(len(run.ok)) / run.settings.timing.frame_rate_hz


def delayed(run: LoopModel) -> Array:
    """Return the change (N, n) of the commands by which they act a second later, to first order.

    A held command that acts later by s lets the one before it act for so long, at the beginning of
    its time. Half of this change is in the time of either one, so that its middle is there.
    """
    changes = np.diff(run.logged, axis=0, prepend=run.logged[:1], append=run.logged[-1:])
    return -run.settings.timing.frame_rate_hz * (changes[:-1] + changes[1:]) / 2


def possible(run: LoopModel, latencies: Array) -> Array:
    """Return latencies (N,) that a loop can have, cut at nothing and at the longest."""
    return np.clip(latencies, 0.0, MAX_DELAY_FRAMES / run.settings.timing.frame_rate_hz)
