"""Prior of the common errors that are estimated with the parameters, and their effect on a loop.

The record states the covariance of the errors of the poses and of the geometry. Standard deviations
of the errors of the latency, of the zeros and the scale of commands, of the constants of friction,
and of the bodies are in the model's side of a scenario. All errors are the same for all poses of a
record.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import xarray as xr

from dynamics import Robot
from dynamics.closed_loop import FrictionLaw, LoopSettings
from identify.arrays import Array
from identify.errors import EstimationError, ScenarioError
from identify.loop_parameters import of_actuators
from identify.model.body_errors import body_error_stds
from identify.model.model_side import ModelSide
from identify.record.conditions import takes_torques
from identify.record.known_geometry import GeometryErrors, read_geometry_covariance
from identify.record.stored_common_errors import (
    FRICTION,
    FRICTION_OFFSET,
    LATENCY,
    SCALE,
    STATIC_RATIO,
    STRIBECK_VELOCITY,
    ZERO,
    read_common_errors,
)
from identify.scenario import Model
from identify.scenario.plant_sections import DRIVE_GAINS

if TYPE_CHECKING:
    from identify.model.loop_model import LoopModel

Run = TypeVar("Run", bound="LoopModel")

LEAST_SCALE = 0.1  # smallest factor of the commands, or of the stated Stribeck velocity, in a model


def with_recorded_errors(
    run: Run,
    record: xr.Dataset,
    side: ModelSide,
    motion: Array,
    own: Mapping[str, float] = MappingProxyType({}),
) -> Run:
    """Return a model with the common errors that are estimated with the parameters.

    run            Model without common errors. Its whitener is needed for them.
    record         Record of the run, with the errors of its poses and of the geometry.
    side           Kinds of errors, and the standard deviations of the errors of the loop and of
                   bodies.
    motion (N, 6)  Poses of the run, which show which errors of the geometry are noticeable.
    own            Standard deviations of further errors in the loop, by name.

    Raises RecordError if the record states errors that are not valid. Raises EstimationError if
    constants of friction are to be estimated under torques. Raises the ScenarioErrors of
    `loop_error_stds` and `body_error_stds`.
    """
    kinds = side.nuisances
    geometry = None
    covariance = read_geometry_covariance(record, run.robot) if "geometry" in kinds else None
    if covariance is not None:
        geometry = GeometryErrors(run.robot, covariance, motion, run.whitener)
    stds = loop_error_stds(run.robot, side.model, side.timing.latency_std_s, kinds)
    if takes_torques(record):
        if any(name.startswith(FRICTION) for name in stds):
            raise EstimationError(
                "the commands of the record are torques, under which no constant of the law of "
                "friction is estimated: leave model.static_ratio_std, stribeck_velocity_std and "
                "friction_offset_std out"
            )
        # no zero and no scale of joint commands acts under torques
        stds = {name: std for name, std in stds.items() if name == LATENCY}
    common = replace(
        read_common_errors(record, kinds),
        loop_std=stds | dict(own),
        geometry=geometry,
        body_std=body_error_stds(run.robot, side.model, kinds),
        whitener=run.whitener,
    )
    return replace(run, common=common)


def loop_error_stds(
    robot: Robot, model: Model, latency_std_s: float, kinds: tuple[str, ...]
) -> dict[str, float]:
    """Return, by name, the standard deviations of some kinds of errors in the loop.

    Errors that are assumed to be zero are left out. latency_std_s: standard deviation of the mean
    latency. Raises ScenarioError if a standard deviation belongs to another kind of actuators or
    another law of friction or drives, or if it belongs to friction and `kinds` leaves friction out.
    """
    stds = {LATENCY: latency_std_s if "latency" in kinds else 0.0}
    zero_std = of_actuators(robot, model, "joint_zero_std") if "zeros" in kinds else 0.0
    layout = robot.layout
    stds |= {zero_name(joint, layout.joint_unit): zero_std for joint in range(layout.joints)}
    stds[SCALE] = model.command_scale_std if "scale" in kinds else 0.0
    friction = _friction_stds(robot, model)
    stated = ", ".join(name for name, std in friction.items() if std)
    if stated and FRICTION not in kinds:
        raise ScenarioError(
            f"the model states how well {stated} are known, but identification.nuisances leaves "
            "'friction' out"
        )
    stds |= friction
    return {name: std for name, std in stds.items() if std}


def zero_name(joint: int, unit: str) -> str:
    """Return the name of the error of a joint's zero. joint: index of the joint, from 0."""
    return f"{ZERO}{joint + 1}_{unit}"


def _friction_stds(robot: Robot, model: Model) -> dict[str, float]:
    """Return, by name, the standard deviations of constants of friction.

    These are the constants of the law of friction, and the offset of the friction of each joint.
    Raises ScenarioError for a law of friction or of the drives that does not have them.
    """
    velocity = f"{STRIBECK_VELOCITY}_{robot.layout.joint_unit}/s"
    stds: dict[str, float] = {
        STATIC_RATIO: model.static_ratio_std,
        velocity: of_actuators(robot, model, "stribeck_velocity_std") or 0.0,
    }
    if any(stds.values()) and model.friction != "stribeck":
        raise ScenarioError(
            f"model.friction = {model.friction!r}, but static_ratio_std or stribeck_velocity_std "
            "is stated: only the law stribeck has these constants"
        )
    offset = of_actuators(robot, model, "friction_offset_std") or 0.0
    if offset and "li" not in DRIVE_GAINS.get(model.drive, ()):
        raise ScenarioError(
            f"model.friction_offset_std with model.drive = {model.drive!r}: it needs a law with an "
            "integral; under the law pd, an offset of friction is an error of the joint's zero"
        )
    unit = robot.layout.unit("joint1.coulomb")
    offsets = {
        f"{FRICTION_OFFSET}{joint}_{unit}": offset for joint in range(1, robot.layout.joints + 1)
    }
    return stds | offsets


def lowest_errors(stds: Mapping[str, float], mean_latency: float, friction: FrictionLaw) -> Array:
    """Return the smallest errors (k,) that a loop can contain, in their standard deviations.

    The mean latency is not negative, static friction is not below Coulomb friction, and scale and
    Stribeck velocity stay above zero. The limit of all other errors is -inf.
    """
    least = {LATENCY: -mean_latency, SCALE: LEAST_SCALE - 1.0}
    if friction.static_ratio is not None and friction.stribeck_velocity is not None:
        least[STATIC_RATIO] = 1.0 - friction.static_ratio
        for name in stds:
            if name.startswith(STRIBECK_VELOCITY):
                least[name] = (LEAST_SCALE - 1.0) * friction.stribeck_velocity
    return np.array([least.get(name, -np.inf) / std for name, std in stds.items()])


def settings_with_errors(settings: LoopSettings, errors: Mapping[str, float]) -> LoopSettings:
    """Return the settings of a loop with errors, in their units, of zeros, scale and friction."""
    if any(name.startswith(FRICTION) for name in errors):
        offsets = tuple(value for name, value in errors.items() if name.startswith(FRICTION_OFFSET))
        settings = replace(
            settings,
            friction=_friction_with(settings.friction, errors),
            drives=replace(settings.drives, friction_offset=offsets),
        )
    zeros = tuple(value for name, value in errors.items() if name.startswith(ZERO))
    scale = 1.0 + errors.get(SCALE, 0.0)
    if scale == 1.0 and not any(zeros):
        return settings
    drives = replace(settings.drives, joint_zeros=zeros, command_scale=scale)
    return replace(settings, drives=drives)


def _friction_with(friction: FrictionLaw, errors: Mapping[str, float]) -> FrictionLaw:
    """Return a law of friction with errors of its constants."""
    if friction.static_ratio is None or friction.stribeck_velocity is None:
        return friction
    velocity = sum(value for name, value in errors.items() if name.startswith(STRIBECK_VELOCITY))
    return replace(
        friction,
        # rounding of the lowest errors can make the ratio slightly smaller than 1
        static_ratio=max(friction.static_ratio + errors.get(STATIC_RATIO, 0.0), 1.0),
        stribeck_velocity=friction.stribeck_velocity + velocity,
    )
