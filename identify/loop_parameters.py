"""The 67 parameters of the closed loop, as the estimator sees them: names, units, typical sizes."""

from dataclasses import dataclass

import numpy as np

from dynamics import Robot
from dynamics.parameters import JOINT_PID_NAMES, PARAMETER_NAMES, unit_of
from identify.arrays import Array
from identify.errors import ScenarioError

NAMES: tuple[str, ...] = PARAMETER_NAMES + JOINT_PID_NAMES

TYPICAL_FRICTION = {"coulomb": 0.1, "viscous": 0.1}
"""Sizes [N m, N m s/rad] where the specification gives no friction: about 1/30 of the reference robot's holding torque."""


@dataclass(frozen=True)
class StartingGuess:
    """What is known before the experiment: values (67,) and their standard deviations (67,), SI."""

    values: Array
    std: Array


def starting_guess(robot: Robot, set_name: str, relative_std: float) -> StartingGuess:
    """The named parameter set of the robot file, uncertain by a fraction of each value's size.

    Raises:
        ScenarioError: no such set (with the valid names).
    """
    if set_name not in robot.parameter_sets:
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(f"robot {robot.name} has no parameter set {set_name!r}; it has {valid}")
    values = robot.parameter_sets[set_name].vector
    return StartingGuess(values, relative_std * typical_sizes(values))


def typical_sizes(values: Array) -> Array:
    """Size (67,) of each parameter, its own value or, where that is zero, the typical one of its kind."""
    kinds = [name.rsplit(".", 1)[1] for name in NAMES]
    fallback = np.array([TYPICAL_FRICTION.get(kind, 1.0) for kind in kinds])
    return np.where(values > 0, values, fallback)


def index_of(name: str) -> int:
    """Position of a parameter in the vector."""
    return NAMES.index(name)


__all__ = ["NAMES", "StartingGuess", "index_of", "starting_guess", "typical_sizes", "unit_of"]
