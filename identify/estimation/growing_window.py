"""Search over a window of a record that grows, for records that begin in motion.

A lightly damped robot oscillates long after its start. If the frequency of the model is wrong, its
phase error grows with time, and over a whole record the cost has many local minima. Over a short
window it has hardly any. The search therefore begins with the first half second of each stretch of
a record (`model.timed_model`). Each following window is twice as long. If the model misses the
longer window, a shorter one is tried. The start of a stretch is estimated together with the
parameters, see `simultaneous_search`.
"""

from dataclasses import replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.simultaneous_search import with_likely_errors

SHORTEST_S = 0.5
"""Length of the window that is tried first, s. It is a few periods of the joint loop."""

LEAST_GROWTH = 1.05
"""Ratio of consecutive windows up to which a window that the model misses is not shortened."""

MOST_WINDOWS = 30
"""Largest number of windows that are searched, even if they do not reach the end of the record."""

MISSED = 2.0
"""Mean squared residual above which the model misses a window."""


def over_growing_window(
    problem: OutputErrorProblem, start: Array
) -> tuple[OutputErrorProblem, Array]:
    """Return the problem with its most likely common errors, and the optimal parameters (p,).

    They are for the longest window that was reached, normally the whole record. start (p,):
    parameters within the bounds. Raises LoopFailure if the model is unstable with the result.
    """
    known, parameters = problem, start
    reached_s = SHORTEST_S / 2.0
    growth = 2.0
    every_good = [run.ok for run in problem.runs]
    for _ in range(MOST_WINDOWS):
        window_s = growth * reached_s
        runs = tuple(run.beginning(window_s) for run in known.runs)
        whole = all(map(np.array_equal, [run.ok for run in runs], every_good))
        part, found = _searched(replace(known, runs=runs), parameters)
        if growth > LEAST_GROWTH and _misses(part, found):
            growth = growth**0.5
            continue
        known = known.having([run.errors_had for run in part.runs])
        parameters = found
        if whole:
            break
        reached_s = window_s
        growth = min(growth**2, 2.0)
    return known.with_common_errors(parameters), parameters


def _searched(part: OutputErrorProblem, start: Array) -> tuple[OutputErrorProblem, Array]:
    """Search one window. If the model is unstable there, the arguments are returned unchanged."""
    try:
        return with_likely_errors(part.with_common_errors(start), start)
    except DynamicsError:
        return part, start


def _misses(part: OutputErrorProblem, parameters: Array) -> bool:
    """Return whether the mean squared residual of a window is above MISSED."""
    return part.cost(parameters) > MISSED * 6 * sum(int(run.ok.sum()) for run in part.runs)
