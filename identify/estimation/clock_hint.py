"""Hint that the commands of a record have a clock of their own, which the record does not state.

If the model does not explain timed records, the search is repeated with such clocks.
"""

from dataclasses import replace

import numpy as np

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.common_error_estimates import errors_of_run
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.output_error_search import output_error_searches
from identify.model.loop_model import LoopModel
from identify.model.timed_model import TimedModel
from identify.progress import SilentProgress
from identify.record.stored_common_errors import CLOCK_OFFSET

TRIED_S = 0.03
"""Prior standard deviation, s, of the offset of the clock that is tried."""

EXPLAINS = 0.3
"""Fraction of the mean squared residual below which the clocks explain too little for a hint."""


def clock_hints(problem: OutputErrorProblem, warm: Array, misfit: float) -> tuple[str, ...]:
    """Return a hint for each timed record that states no clock of its commands.

    There are no hints unless such clocks, tried for all these records together, explain enough of
    the misfit. warm (p,): parameters from which the search began. misfit: mean squared whitened
    residual of all records without these clocks.
    """
    unstated = [_lacks_clock(run) for run in problem.runs]
    if not any(unstated):
        return ()
    runs = tuple(
        _with_clock(run) if lacks else run
        for run, lacks in zip(problem.runs, unstated, strict=True)
    )
    tried = replace(problem, runs=runs)
    try:
        found = output_error_searches(tried, warm, closed_loop=False, progress=SilentProgress())
        judged = found["command_driven"].linearised()
    except EstimationError:
        return ()
    parameters = found["command_driven"].solution.parameters
    residuals = np.concatenate([run.residuals(parameters) for run in judged.runs])
    remaining = float(np.mean(residuals**2))
    if remaining > (1 - EXPLAINS) * misfit:
        return ()
    hints = []
    for number, (run, lacks) in enumerate(zip(judged.runs, unstated, strict=True), start=1):
        if not lacks:
            continue
        errors = run.common.whole_factor @ errors_of_run(run, parameters)
        offset = 1e3 * errors[run.common.all_names.index(CLOCK_OFFSET)]
        of_record = f" of record {number}" if len(runs) > 1 else ""
        hints.append(
            f"the commands{of_record} seem to act {offset:.2f} ms after their times, which reduces "
            f"the mean squared residual from {misfit:.4g} to {remaining:.4g}: let their clock be "
            "estimated (timing.clock_offset_std_s)"
        )
    return tuple(hints)


def _lacks_clock(run: LoopModel) -> bool:
    """Return whether a run is timed, and states no clock of its commands."""
    return isinstance(run, TimedModel) and CLOCK_OFFSET not in run.common.loop_std


def _with_clock(run: LoopModel) -> LoopModel:
    """Return a run whose commands have a separate clock."""
    common = replace(run.common, loop_std=run.common.loop_std | {CLOCK_OFFSET: TRIED_S})
    return replace(run, common=common, drawn=None, marginal=None)
