"""Causes between the log of the commands and the drives: their scale, and clocks."""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.diagnosis.cause import Cause, in_each_run, prior_std
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
        seconds = np.arange(len(run.ok)) / timing.frame_rate_hz
        return replace(run, acted=possible(run, run.stated_latencies + size * seconds))

    earliest = min(float(run.stated_latencies.min()) for run in problem.runs)
    longest = max(len(run.ok) for run in problem.runs) / timing.frame_rate_hz
    return (
        Cause(
            name="latency of the commands",
            unit="s",
            group="latency of the commands",
            change=in_each_run(later),
            step=CLOCK_STEP_S,
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
            remedy=lambda size: (
                f"correct the times of the commands by {1e6 * size:.3g} us a second, or give "
                "cameras and drives one clock"
            ),
            least=-earliest / longest,
        ),
    )


def possible(run: LoopModel, latencies: Array) -> Array:
    """Return latencies (N,) that a loop can have, cut at nothing and at the longest."""
    return np.clip(latencies, 0.0, MAX_DELAY_FRAMES / run.settings.timing.frame_rate_hz)
