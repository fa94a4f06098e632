"""Loop of a model that contains errors of the latency, of the zeros and of the scale of commands.

These errors are the same for all poses of a record, and are estimated beside the parameters. Their
standard deviations are those of the model's side of a scenario.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import LoopSettings
from identify.arrays import Array
from identify.loop_parameters import of_actuators
from identify.record.stored_common_errors import LATENCY, SCALE, ZERO
from identify.scenario import Model

LEAST_SCALE = 0.1
"""Smallest scale of the commands that a model can contain."""


def loop_error_stds(
    robot: Robot, model: Model, latency_std_s: float, kinds: tuple[str, ...]
) -> dict[str, float]:
    """Return the standard deviations of the errors in the loop by name, of some kinds.

    Errors that are assumed to be zero are left out. latency_std_s: of the mean latency. Raises the
    ScenarioError of `of_actuators`.
    """
    found = {LATENCY: latency_std_s if "latency" in kinds else 0.0}
    zero = of_actuators(robot, model, "joint_zero_std") if "zeros" in kinds else 0.0
    layout = robot.layout
    found |= {zero_name(joint, layout.joint_unit): zero for joint in range(layout.joints)}
    found[SCALE] = model.command_scale_std if "scale" in kinds else 0.0
    return {name: std for name, std in found.items() if std}


def zero_name(joint: int, unit: str) -> str:
    """Return the name of the error of the zero of a joint, which is counted from 0."""
    return f"{ZERO}{joint + 1}_{unit}"


def lowest_errors(stds: Mapping[str, float], mean_latency: float) -> Array:
    """Return the smallest errors (k,) that a loop can contain, in their standard deviations.

    No latency is negative, and the scale of the commands stays above zero.
    """
    least = {LATENCY: -mean_latency, SCALE: LEAST_SCALE - 1.0}
    return np.array([least.get(name, -np.inf) / std for name, std in stds.items()])


def settings_with_errors(settings: LoopSettings, errors: Mapping[str, float]) -> LoopSettings:
    """Return the settings of a loop whose drives have some errors of zeros and scale."""
    zeros = tuple(value for name, value in errors.items() if name.startswith(ZERO))
    scale = 1.0 + errors.get(SCALE, 0.0)
    if scale == 1.0 and not any(zeros):
        return settings
    drives = replace(settings.drives, joint_zeros=zeros, command_scale=scale)
    return replace(settings, drives=drives)
