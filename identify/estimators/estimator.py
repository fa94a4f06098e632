"""What an estimator is: what it is given, what it gives back, and all of them by name.

An estimator is a function (evidence) -> Estimate, named in `identify.plugins` or given as
``module:function``; the decorator `estimator` says in words what it is.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from dynamics.errors import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.plugins import ESTIMATORS, Telling, check_choice, chosen, is_own
from identify.scenario import Scenario


@dataclass(frozen=True)
class JointChannels:
    """Channels of n joints: torque (N, n) in N m or N, mean over a frame, and encoder angle (N, n)
    in rad or m.
    """

    torque: Array
    angle: Array
    torque_std: float


@dataclass(frozen=True)
class Evidence:
    """All that an estimator may use: the record as an output-error problem, with starting guess and
    scale anchor; channels of the joints where there are any; gains of the joint PID (lp, li, ld)
    where they are known."""

    problem: OutputErrorProblem
    scenario: Scenario
    channels: JointChannels | None = None
    known_gains: Array | None = None

    @property
    def run(self) -> LoopModel:
        """The record. The estimators of this package that use the joints take one only."""
        return self.problem.runs[0]

    def joint_channels(self) -> JointChannels:
        """The channels. Raises EstimationError where the record has none."""
        if self.channels is None:
            raise EstimationError(
                "the record has no joint channels: this estimator needs a measured torque"
            )
        return self.channels


@dataclass(frozen=True)
class Estimate:
    """Parameters (p,) with standard deviations (p,) (None: the method states none), seconds without
    those of the standard deviations, iterations (searches: steps; linear fits: solutions),
    evaluations: simulated runs of the model, those with sensitivities counted once."""

    parameters: Array
    std: Array | None
    seconds: float = 0.0
    iterations: int = 0
    evaluations: int = 0
    note: str = ""


@dataclass(eq=False)
class Estimator:
    """An estimator: what it is in words, what it uses beside the commands, and the function, as
    which it is called.
    """

    title: str
    uses: str
    estimate: Callable[[Evidence], Estimate]

    def __post_init__(self) -> None:
        functools.update_wrapper(self, self.estimate)

    def __call__(self, evidence: Evidence) -> Estimate:
        """The function's estimate. Raises EstimationError, or dynamics.DynamicsError, where there
        is none.
        """
        return self.estimate(evidence)


def estimator(title: str, uses: str) -> Callable[[Callable[[Evidence], Estimate]], Estimator]:
    """Decorator that makes an estimator of a function."""
    return functools.partial(Estimator, title, uses)


def find_estimators(names: Sequence[str] | None = None) -> dict[str, Estimator]:
    """The built-in estimators of these names, or all, in the order of their table; then those of a
    user's own.

    Raises ScenarioError for one that does not exist, with the valid names, or cannot be imported.
    """
    for name in names or ():
        check_choice(name, "estimator", ESTIMATORS)
    wanted = [name for name in ESTIMATORS if not names or name in names] + [
        name for name in names or () if is_own(name)
    ]
    return {name: _found(name) for name in wanted}


def _found(name: str) -> Estimator:
    found = chosen(name, "estimator", ESTIMATORS)
    return found if isinstance(found, Estimator) and not is_own(name) else _own(name, found)


def _own(name: str, function: Callable[..., Any]) -> Estimator:
    """Estimator of a user's own, of which all that goes wrong is an EstimationError in a line."""
    known = (EstimationError, DynamicsError)
    told = Telling(f"estimator {name!r}", function, EstimationError, known, _check_estimate)
    title = getattr(function, "title", name)
    return Estimator(title, getattr(function, "uses", ""), told)


def _check_estimate(part: str, found: object, evidence: Evidence) -> None:
    """Raise EstimationError unless an estimator of a user's own has returned what it should."""
    if not isinstance(found, Estimate):
        raise EstimationError(f"{part} must return an Estimate, returned {type(found).__name__}")
    shape = np.shape(evidence.problem.guess.values)
    for name in ("parameters", "std"):
        values = getattr(found, name)
        if name == "std" and values is None:
            continue
        if np.shape(values) != shape or not np.isfinite(np.asarray(values, dtype=float)).all():
            raise EstimationError(f"{part} must return finite {name} {shape}")


TORQUE_NOISE = ("torque_noise_N_m", "force_noise_N")
"""Attribute of joint channels with the standard deviation of a measured torque, or of a force."""


def joint_channels(channels: xr.Dataset, record: xr.Dataset) -> JointChannels:
    """Channels of a dataset that belongs to the record.

    Raises RecordError where the two were not recorded at the same instants.
    """
    ours = record["time"].values
    theirs = channels["time"].values
    if len(ours) != len(theirs) or np.abs(ours - theirs).max() > 1e-9:
        raise RecordError(
            f"the joint channels have {len(theirs)} frames up to t = {theirs[-1]:.3f} s, the "
            f"record {len(ours)} up to "
            f"{ours[-1]:.3f} s: they are of another run"
        )
    torque, angle = (
        np.asarray(channels[name].values, dtype=float) for name in ("joint_torque", "joint_angle")
    )
    return JointChannels(
        torque,
        angle,
        next(float(channels.attrs[name]) for name in TORQUE_NOISE if name in channels.attrs),
    )
