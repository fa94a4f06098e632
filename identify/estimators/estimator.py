"""Interface of an estimator: its input, its output, and the look-up of estimators by name.

An estimator is a function (evidence) -> Estimate, named in `identify.own_parts` or given as
``module:function``. The decorator `estimator` adds a description.
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
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.own_parts import ESTIMATORS, PluginFunction, check_choice, chosen, is_plugin_name


@dataclass(frozen=True)
class JointChannels:
    """Measured channels of n joints.

    torque (N, n): means over a frame, N m or N, with standard deviation torque_std. angle (N, n):
    readings of the encoders, rad or m.
    """

    torque: Array
    angle: Array
    torque_std: float


@dataclass(frozen=True)
class Evidence:
    """Input of an estimator.

    problem: the record as an output-error problem, with initial guess and scale anchor. channels:
    measured channels of the joints, or None. known_gains (3,) or (3 n,): gains of the joint PID, or
    None if they are unknown.
    """

    problem: OutputErrorProblem
    channels: JointChannels | None = None
    known_gains: Array | None = None

    @property
    def run(self) -> LoopModel:
        """Model of the first record, the only one that estimators with joint channels use."""
        return self.problem.runs[0]

    def joint_channels(self) -> JointChannels:
        """Return the joint channels. Raises EstimationError if the record has none."""
        if self.channels is None:
            raise EstimationError(
                "the record has no joint channels: this estimator needs a measured torque"
            )
        return self.channels


@dataclass(frozen=True)
class Estimate:
    """Parameters (p,) found by an estimator, with their standard deviations or None.

    seconds: duration without the computation of standard deviations. iterations: steps of a search,
    or solutions of a linear fit. evaluations: simulated runs of the model. A run with sensitivities
    counts once. note: remark on the estimation, such as why a search ended.
    """

    parameters: Array
    std: Array | None
    seconds: float = 0.0
    iterations: int = 0
    evaluations: int = 0
    note: str = ""


@dataclass(eq=False)
class Estimator:
    """Estimating function with a title. It is called like the function.

    uses: inputs of the function other than the commands, in words.
    """

    title: str
    uses: str
    estimate: Callable[[Evidence], Estimate]

    def __post_init__(self) -> None:
        functools.update_wrapper(self, self.estimate)

    def __call__(self, evidence: Evidence) -> Estimate:
        """Return the function's estimate.

        Raises EstimationError or dynamics.DynamicsError if the estimation fails.
        """
        return self.estimate(evidence)


def estimator(title: str, uses: str) -> Callable[[Callable[[Evidence], Estimate]], Estimator]:
    """Return a decorator that makes an Estimator from a function."""
    return functools.partial(Estimator, title, uses)


def find_estimators(names: Sequence[str] | None = None) -> dict[str, Estimator]:
    """Return the estimators of these names, by default all built-in estimators.

    Built-in estimators come first, in the order of their table, then a user's own. Raises
    ScenarioError, with the valid names, if an estimator does not exist or cannot be imported.
    """
    for name in names or ():
        check_choice(name, "estimator", ESTIMATORS)
    built_in = [name for name in ESTIMATORS if not names or name in names]
    own = [name for name in names or () if is_plugin_name(name)]
    return {name: _found(name) for name in built_in + own}


def _found(name: str) -> Estimator:
    found = chosen(name, "estimator", ESTIMATORS)
    # Only a user's own estimator needs its errors converted.
    return found if isinstance(found, Estimator) and not is_plugin_name(name) else _own(name, found)


def _own(name: str, function: Callable[..., Any]) -> Estimator:
    """Return a user's own estimator. All its failures become an EstimationError in one line."""
    known = (EstimationError, DynamicsError)
    checked = PluginFunction(
        f"estimator {name!r}", function, EstimationError, known, _check_estimate
    )
    title = getattr(function, "title", name)
    return Estimator(title, getattr(function, "uses", ""), checked)


def _check_estimate(part: str, found: object, evidence: Evidence) -> None:
    """Raise EstimationError unless a user's own estimator has returned a valid Estimate."""
    if not isinstance(found, Estimate):
        raise EstimationError(f"{part} must return an Estimate, returned {type(found).__name__}")
    shape = np.shape(evidence.problem.guess.values)
    for name in ("parameters", "std"):
        values = getattr(found, name)
        if name == "std" and values is None:
            continue
        if np.shape(values) != shape or not np.isfinite(np.asarray(values, dtype=float)).all():
            raise EstimationError(f"{part} must return finite {name} {shape}")


# Attributes of joint channels with the standard deviation of a measured torque or force.
TORQUE_NOISE = ("torque_noise_N_m", "force_noise_N")


def joint_channels(channels: xr.Dataset, record: xr.Dataset) -> JointChannels:
    """Return the channels of a dataset that belongs to the record.

    Raises RecordError if the two were not recorded at the same instants.
    """
    ours = record["time"].values
    theirs = channels["time"].values
    if len(ours) != len(theirs) or np.abs(ours - theirs).max() > 1e-9:
        raise RecordError(
            f"the joint channels have {len(theirs)} frames up to t = {theirs[-1]:.3f} s, the "
            f"record {len(ours)} up to {ours[-1]:.3f} s: they are of another run"
        )
    torque, angle = (
        np.asarray(channels[name].values, dtype=float) for name in ("joint_torque", "joint_angle")
    )
    noise = next(float(channels.attrs[name]) for name in TORQUE_NOISE if name in channels.attrs)
    return JointChannels(torque, angle, noise)
