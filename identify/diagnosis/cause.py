"""Causes for which a model may miss its record, as changes of the problem that was solved.

A cause has a size, zero where the model is right. At another size, it turns the output-error
problem that was solved into one with other commands, another clock or another robot. The derivative
of the residuals with respect to the size is the column of the cause. The columns of causes that
name their effects follow from one run of the model, which is differentiated along many directions
at once. The other columns are differences of runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel

# Function that returns the problem with a cause of a given size, and changes nothing else.
Change = Callable[[OutputErrorProblem, float], OutputErrorProblem]
# Function (run, its index) that returns what a cause of size one changes at each frame.
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
    """Effect of a cause that changes one gain. joint: index from 0. kind: index in JOINT_PID."""

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
    """Remedy that adds an entry to a list in the settings.

    key: key of the list. known: entries that the model has. entry: entry to add.
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
        Name of a group of similar causes. A group is also judged as a whole, unless exclusive.
    change : callable
        Function (problem, size) that returns the problem with this cause.
    step : float
        Change of the size for differences, so small that residuals change in proportion, and so
        large that rounding does not matter. Zero: the cause has no size, and is there or not.
    remedy : callable or InList
        Function (size) that returns an option to type, or a sentence on what to do. InList: entry
        that a list of settings needs.
    least : float
        Least possible size.
    effect : Effect, optional
        Effect of size one. None: the column is a difference of runs.
    alone : bool
        True if the cause is also asked alone. False: it is asked only together with its group.
    exclusive : bool
        True if at most one cause of the group can be there.
    companion : Cause, optional
        Cause that has an effect only beside this one, and is fitted together with it.
    renewed : callable, optional
        Function (problem with the causes, parameters) that returns this cause with its effect along
        the motion of that problem. None: a fit keeps the first effect.
    anew : callable, optional
        Function (problem with other causes, parameters) that returns this cause as it is asked at
        the optimum of that problem. None: its sizes are not relative to the motion.
    exact : bool
        True if the fit of a true cause leaves only noise. False: its effect is only known to first
        order, or joints that stick keep a fit from the optimum.
    tried : tuple of float
        Trial sizes, for a cause that shows nothing at a small size. Empty: it is asked at size 0.
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
        """True if the column is a difference of runs, and the cause has a size."""
        return self.effect is None and self.step > 0


def in_each_run(change: Callable[[LoopModel, float], LoopModel]) -> Change:
    """Return the change of a problem that changes each of its runs by the same size."""

    def changed(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return replace(problem, runs=tuple(change(run, size) for run in problem.runs))

    return changed


def prior_std(size: float, least: float) -> float:
    """Return the smallest power of ten not below |size| and `least`, as a prior standard deviation.

    `least` is usual in workshops, so that most causes of a kind have the same standard deviation.
    """
    return float(10.0 ** np.ceil(np.log10(max(abs(size), least))))


def with_causes(
    problem: OutputErrorProblem, causes: Sequence[Cause], sizes: Array
) -> OutputErrorProblem:
    """Return the problem with causes of sizes (k,)."""
    # a cause of size zero changes nothing
    present = [(one, float(size)) for one, size in zip(causes, sizes, strict=True) if size]
    geometric = [
        size * one.effect.deviations for one, size in present if isinstance(one.effect, OnGeometry)
    ]
    if geometric:
        # to move a robot takes longer than to run it, so it is moved once by all deviations
        problem = with_geometry(problem, np.sum(geometric, axis=0))
    others = [pair for pair in present if not isinstance(pair[0].effect, OnGeometry)]
    return reduce(lambda changed, pair: pair[0].change(changed, pair[1]), others, problem)


def with_geometry(problem: OutputErrorProblem, deviations: Array) -> OutputErrorProblem:
    """Return the problem of a robot whose geometric numbers are off by deviations (g,)."""
    robot = _moved(problem.runs[0].robot, deviations.tobytes())
    return replace(problem, runs=tuple(replace(run, robot=robot) for run in problem.runs))


@lru_cache(maxsize=8)
def _moved(robot: Robot, deviations: bytes) -> Robot:
    """Return the robot moved by deviations (g,), which are bytes because the cache needs a hash."""
    return robot.moved(np.frombuffer(deviations))
