"""The prior: what is known beside the poses, as residuals that join theirs.

That is the starting guess, each parameter with its standard deviation (wide, but for single ones of which a scenario's
`[identification.prior]` knows more), and the scale anchor.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dynamics import Robot
from dynamics.parameters import COULOMB_NAMES, VISCOUS_NAMES
from identify.arrays import Array
from identify.estimation.scale_anchor import ScaleAnchor
from identify.loop_parameters import NAMES, check_parameter_set, index_of
from identify.scenario import PriorValue


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

    Raises ScenarioError: no such set (with the valid names).
    """
    check_parameter_set(robot, set_name)
    chosen = robot.parameter_sets[set_name]
    torque = holding_torque(robot, chosen.dynamic)
    values, std = chosen.vector.copy(), relative_std * typical_sizes(chosen.vector, torque)
    for name, prior in known.items():
        values[index_of(name)], std[index_of(name)] = prior.value, prior.std
    return StartingGuess(values, std)


def holding_torque(robot: Robot, dynamic: Array) -> float:
    """Mean torque [N m] that the joints hold at the home pose, with dynamic parameters (64,)."""
    return float(np.abs(robot.static_torque(robot.home_pose, dynamic)).mean())


def typical_sizes(values: Array, torque: float) -> Array:
    """Size (67,) of each parameter: its own value, and for friction [N m, N m s/rad] the holding torque [N m].

    A specification says little about friction; a joint that rubs more than it carries would be called broken.
    """
    friction = np.isin(NAMES, COULOMB_NAMES + VISCOUS_NAMES)
    return np.where(friction, torque, np.where(values > 0, values, 1.0))


def prior_residuals(parameters: Array, guess: StartingGuess, anchor: ScaleAnchor) -> tuple[Array, Array]:
    """Residuals (k,) of what is known beside the poses, in standard deviations, and their rows (k, 67)."""
    place, measured = anchor.row()
    rows = np.vstack([np.diag(1 / guess.std), place])
    values = np.concatenate([guess.values / guess.std, measured])
    return rows @ parameters - values, rows
