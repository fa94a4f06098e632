"""Causes for which a model may miss its record, as changes of the problem that was solved.

A cause has a size, zero where the model is right. At a size it makes another output-error problem
of the one that was solved: of other commands, another clock or another robot. The difference of
their residuals is the column of the cause.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel

Change = Callable[[OutputErrorProblem, float], OutputErrorProblem]
"""Function that returns the problem with a cause of a given size. It changes nothing else."""

Columns = Callable[[OutputErrorProblem, Array], Array]
"""Function (problem, parameters) that returns columns (m, g) of the residuals."""


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
        proportion, and so large that rounding does not count. Zero: the cause is there or not.
    remedy : callable
        Function (size) that returns a line to type, or one sentence of what to do.
    least : float
        Least size that there can be.
    quick : callable and int, optional
        Function (problem, parameters) that returns columns (m, g) of several causes at once, and
        the place of this one among them. None: columns are differences of runs.
    alone : bool
        True if the cause is asked alone, too. False: only together with its group.
    exclusive : bool
        True if at most one cause of the group can be there.
    companion : Cause, optional
        Cause that has a size only where this one is there, and is then fitted with it.
    deviations : ndarray, shape (g,), optional
        Change of the robot's geometric numbers by a size of one, for causes in the geometry.
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
    quick: tuple[Columns, int] | None = None
    alone: bool = True
    exclusive: bool = False
    companion: "Cause | None" = None
    deviations: Array | None = None


def in_each_run(change: Callable[[LoopModel, float], LoopModel]) -> Change:
    """Return the change of a problem that changes each of its runs by the same size."""

    def changed(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return replace(problem, runs=tuple(change(run, size) for run in problem.runs))

    return changed


def prior_std(size: float, least: float) -> float:
    """Return the standard deviation, a power of ten, with which a model allows for a size.

    It is at least that of an ordinary workshop, so that several causes of a kind have the same.
    """
    return float(10.0 ** np.ceil(np.log10(max(abs(size), least))))


def pose_columns(problem: OutputErrorProblem, parameters: Array, changes: Sequence[Array]) -> Array:
    """Return the columns (m, k) of changes (N, 6, k) of each run's poses against the measured."""
    known, _ = problem.known(parameters)
    parts = [np.zeros((len(known), changes[0].shape[2]))]
    for run, change in zip(problem.runs, changes, strict=True):
        white = run.without_common(np.asarray(run.whitener @ change[run.ok]))
        parts.append(white.reshape(-1, change.shape[2]))
    return np.vstack(parts)


def with_causes(
    problem: OutputErrorProblem, causes: Sequence[Cause], sizes: Array
) -> OutputErrorProblem:
    """Return the problem with several causes, each of its size (k,)."""
    # one of size zero changes nothing
    present = [(one, float(size)) for one, size in zip(causes, sizes, strict=True) if size]
    geometric = [size * one.deviations for one, size in present if one.deviations is not None]
    if geometric:
        # a robot is moved once for all numbers, which takes longer than a run of it
        problem = with_geometry(problem, np.sum(geometric, axis=0))
    others = [pair for pair in present if pair[0].deviations is None]
    return reduce(lambda changed, pair: pair[0].change(changed, pair[1]), others, problem)


def with_geometry(problem: OutputErrorProblem, deviations: Array) -> OutputErrorProblem:
    """Return the problem of a robot whose geometric numbers are off by deviations (g,)."""
    robot = _moved(problem.runs[0].robot, deviations.tobytes())
    return replace(problem, runs=tuple(replace(run, robot=robot) for run in problem.runs))


@lru_cache(maxsize=8)
def _moved(robot: Robot, deviations: bytes) -> Robot:
    """Return a moved robot, which a fit asks for several times. Bytes, as arrays are no keys."""
    return robot.moved(np.frombuffer(deviations))
