"""The 67 parameters of the closed loop, as the estimator sees them: names, units, typical sizes."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dynamics import Robot
from dynamics.parameters import COULOMB_NAMES, JOINT_PID_NAMES, PARAMETER_NAMES, VISCOUS_NAMES, unit_of
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.scenario import PriorValue

NAMES: tuple[str, ...] = PARAMETER_NAMES + JOINT_PID_NAMES


@dataclass(frozen=True)
class StartingGuess:
    """What is known before the experiment: values (67,) and their standard deviations (67,), SI."""

    values: Array
    std: Array


def starting_guess(
    robot: Robot, set_name: str, relative_std: float, known: Mapping[str, PriorValue] = MappingProxyType({})
) -> StartingGuess:
    """The named parameter set of the robot file, uncertain by a fraction of each parameter's size, but for those of
    which a value and its standard deviation are known.

    Raises:
        ScenarioError: no such set (with the valid names).
    """
    check_parameter_set(robot, set_name)
    chosen = robot.parameter_sets[set_name]
    torque = holding_torque(robot, chosen.dynamic)
    values, std = chosen.vector.copy(), relative_std * typical_sizes(chosen.vector, torque)
    for name, prior in known.items():
        values[index_of(name)], std[index_of(name)] = prior.value, prior.std
    return StartingGuess(values, std)


def check_parameter_set(robot: Robot, set_name: str) -> None:
    """Raise ScenarioError, with the valid names, when the robot file has no such parameter set."""
    if set_name not in robot.parameter_sets:
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(f"robot {robot.name} has no parameter set {set_name!r}; it has {valid}")


def holding_torque(robot: Robot, dynamic: Array) -> float:
    """Mean torque [N m] that the joints hold at the home pose, with dynamic parameters (64,)."""
    return float(np.abs(robot.static_torque(robot.home_pose, dynamic)).mean())


def typical_sizes(values: Array, torque: float) -> Array:
    """Size (67,) of each parameter: its own value, and for friction [N m, N m s/rad] the holding torque [N m].

    A specification says little about friction; a joint that rubs more than it carries would be called broken.
    """
    friction = np.isin(NAMES, COULOMB_NAMES + VISCOUS_NAMES)
    return np.where(friction, torque, np.where(values > 0, values, 1.0))


def index_of(name: str) -> int:
    """Position of a parameter in the vector."""
    return NAMES.index(name)


__all__ = ["NAMES", "StartingGuess", "holding_torque", "index_of", "starting_guess", "typical_sizes", "unit_of"]
