"""Causes for which a model may miss its record, as changes of the problem that was solved.

A cause has a size, zero where the model is right. At a size it makes another output-error problem
of the one that was solved: of other commands, another clock or another robot. The difference of
their residuals is the column of the cause.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel

Change = Callable[[OutputErrorProblem, float], OutputErrorProblem]
"""Function that returns the problem with a cause of a given size. It changes nothing else."""


@dataclass(frozen=True)
class Cause:
    """Cause for which a model may miss its record.

    Attributes
    ----------
    name : str
        Name in plain words, such as "zero of joint 2".
    unit : str
        Unit of the size.
    group : str
        Name of the causes that this one is of a kind with. They are also judged together.
    change : callable
        Function (problem, size) that returns the problem with this cause.
    step : float
        Size by which the cause is moved for a difference, so small that residuals follow in
        proportion, and so large that rounding does not count.
    remedy : callable
        Function (size) that returns a line to type, or one sentence of what to do.
    least : float
        Least size that there can be.
    tried : tuple of float
        Sizes at which the cause is looked for, where a small one shows nothing. Empty: about zero.
    """

    name: str
    unit: str
    group: str
    change: Change
    step: float
    remedy: Callable[[float], str]
    least: float = -np.inf
    tried: tuple[float, ...] = ()


def in_each_run(change: Callable[[LoopModel, float], LoopModel]) -> Change:
    """Return the change of a problem that changes each of its runs by the same size."""

    def changed(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return replace(problem, runs=tuple(change(run, size) for run in problem.runs))

    return changed


def with_causes(
    problem: OutputErrorProblem, causes: Sequence[Cause], sizes: Array
) -> OutputErrorProblem:
    """Return the problem with several causes, each of its size (k,)."""
    # one of size zero changes nothing
    present = [(one, float(size)) for one, size in zip(causes, sizes, strict=True) if size]
    return reduce(lambda changed, pair: pair[0].change(changed, pair[1]), present, problem)
