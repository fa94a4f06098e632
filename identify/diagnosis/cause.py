"""Causes for which a model may miss its record, as changes of the problem that was solved.

A cause has a size, zero where the model is right. At a size it makes another output-error problem
of the one that was solved: of other commands, another clock or another robot. The difference of
their residuals is the column of the cause. Most columns also follow from one run of the model that
is differentiated along many directions at once, for which a cause names its effect.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel

# Function that returns the problem with a cause of a given size. It changes nothing else.
Change = Callable[[OutputErrorProblem, float], OutputErrorProblem]
# Function (run, its place) that returns what a cause of size one changes at each frame.
RunColumn = Callable[[LoopModel, int], Array]


@dataclass(frozen=True)
class OnCommands:
    """Effect of a cause that changes the commands of a run, by `changes` (N, n)."""

    changes: RunColumn


@dataclass(frozen=True)
class OnTorques:
    """Effect of a cause for which joints need further torques (N, n), one array for each run."""

    torques: tuple[Array, ...]


@dataclass(frozen=True)
class OnGain:
    """Effect of a cause that changes one gain of one joint. Both are counted from 0."""

    joint: int
    kind: int


@dataclass(frozen=True)
class OnGeometry:
    """Effect of a cause that changes the robot's geometric numbers, by `deviations` (g,)."""

    deviations: Array


@dataclass(frozen=True)
class OnPoses:
    """Effect of a cause that changes the measured poses of a run, by `changes` (N, 6)."""

    changes: RunColumn


Effect = OnCommands | OnTorques | OnGain | OnGeometry | OnPoses


@dataclass(frozen=True)
class InList:
    """Remedy that is an entry of a list of settings, beside those that the model has and others.

    key: of the list. known: its entries so far. entry: the further one.
    """

    key: str
    known: tuple[str, ...]
    entry: str


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
    remedy : callable or InList
        Function (size) that returns a line to type, or one sentence of what to do. Or the entry
        that a list of settings needs.
    least : float
        Least size that there can be.
    effect : Effect, optional
        Effect of a size of one. None: the column is a difference of runs.
    alone : bool
        True if the cause is asked alone, too. False: only together with its group.
    exclusive : bool
        True if at most one cause of the group can be there.
    companion : Cause, optional
        Cause that has a size only where this one is there, and is then fitted with it.
    renewed : callable, optional
        Function (problem with the causes, parameters) that returns this cause with its effect along
        the motion there, if its effect depends on it.
    anew : callable, optional
        Function (problem with other causes, parameters) that returns this cause as it is asked at
        their optimum, if its sizes are relative to the motion.
    exact : bool
        True if the model with this cause is the true one. False: it follows to first order, or
        joints that stick keep a fit from its optimum.
    tried : tuple of float
        Sizes at which the cause is looked for, where a small one shows nothing. Empty: about zero.
    """

    name: str
    unit: str
    group: str
    change: Change
    step: float
    remedy: Callable[[float], str] | InList
    least: float = -np.inf
    tried: tuple[float, ...] = ()
    effect: Effect | None = None
    anew: "Callable[[OutputErrorProblem, Array], Cause] | None" = None
    exact: bool = False
    alone: bool = True
    exclusive: bool = False
    companion: "Cause | None" = None
    renewed: "Callable[[OutputErrorProblem, Array], Cause] | None" = None

    @property
    def differentiable(self) -> bool:
        """True if differences of runs tell more than that the cause is there."""
        return self.effect is None and self.step > 0


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


def with_causes(
    problem: OutputErrorProblem, causes: Sequence[Cause], sizes: Array
) -> OutputErrorProblem:
    """Return the problem with several causes, each of its size (k,)."""
    # one of size zero changes nothing
    present = [(one, float(size)) for one, size in zip(causes, sizes, strict=True) if size]
    geometric = [
        size * one.effect.deviations for one, size in present if isinstance(one.effect, OnGeometry)
    ]
    if geometric:
        # a robot is moved once for all numbers, which takes longer than a run of it
        problem = with_geometry(problem, np.sum(geometric, axis=0))
    others = [pair for pair in present if not isinstance(pair[0].effect, OnGeometry)]
    return reduce(lambda changed, pair: pair[0].change(changed, pair[1]), others, problem)


def with_geometry(problem: OutputErrorProblem, deviations: Array) -> OutputErrorProblem:
    """Return the problem of a robot whose geometric numbers are off by deviations (g,)."""
    robot = _moved(problem.runs[0].robot, deviations.tobytes())
    return replace(problem, runs=tuple(replace(run, robot=robot) for run in problem.runs))


@lru_cache(maxsize=8)
def _moved(robot: Robot, deviations: bytes) -> Robot:
    """Return a moved robot, which a fit asks for several times. Bytes, as arrays are no keys."""
    return robot.moved(np.frombuffer(deviations))
