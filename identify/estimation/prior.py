"""Starting guess: each parameter with its standard deviation before the experiment.

That is wide, but for parameters of which a scenario's `[identification.prior]` knows more.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop.drives import ABOVE_ZERO, READS, DriveName
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.loop_parameters import check_parameter_set
from identify.scenario import Model, PriorValue
from identify.scenario.sections import Identification


@dataclass(frozen=True)
class StartingGuess:
    """Knowledge of a robot's parameters before the experiment.

    values, std (p,): values and their standard deviations, SI. drive: law of the drives, whose
    unread gains are fixed at zero.
    """

    layout: ParameterLayout
    values: Array
    std: Array
    drive: DriveName = "pid"

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Gains (p,) that the law of the drives does not read."""
        read = [f"joint_pid.{gain}" for gain in READS[self.drive]]
        names = self.layout.names
        return np.isin(names, self.layout.joint_pid_names) & ~np.isin(names, read)

    @property
    def above_zero(self) -> tuple[str, ...]:
        """Parameters without which there is no model."""
        return ("platform.mass", *(f"joint_pid.{gain}" for gain in ABOVE_ZERO[self.drive]))

    @property
    def rows(self) -> Array:
        """Rows (p, p) of the guess as equations of the parameters, in standard deviations."""
        return np.diag(1 / self.std)


FIXED = 1e-9
"""Standard deviation of a gain that the law of the drives does not read.

It is a share of the one that the gain would have otherwise.
"""


def starting_guess(
    robot: Robot,
    set_name: str,
    relative_std: float,
    known: Mapping[str, PriorValue] = MappingProxyType({}),
    drive: DriveName = "pid",
) -> StartingGuess:
    """Return the starting guess that follows from a parameter set of the robot file.

    relative_std: standard deviation of each parameter, as a fraction of its size. known: values and
    standard deviations of parameters of which more is known, by name. Raises ScenarioError, with
    the valid names, if there is no such set.
    """
    check_parameter_set(robot, set_name)
    chosen = robot.parameter_sets[set_name]
    torque = holding_torque(robot, chosen.dynamic)
    values = chosen.vector.copy()
    std = relative_std * typical_sizes(robot.layout, chosen.vector, torque)
    for name, prior in known.items():
        place = robot.layout.names.index(name)
        values[place] = prior.value
        std[place] = prior.std
    guess = StartingGuess(robot.layout, values, std, drive)
    # the guess holds these very arrays, and changes with them
    values[guess.fixed] = 0.0
    std[guess.fixed] = FIXED * std[guess.fixed]
    return guess


def model_guess(robot: Robot, model: Model, settings: Identification) -> StartingGuess:
    """Return the starting guess of a model, with what the settings say of its parameters.

    Raises ScenarioError as `starting_guess`.
    """
    return starting_guess(
        robot, model.start_parameters, settings.start_std, settings.prior, model.drive_law
    )


WEIGHTLESS = 0.01
"""Share of the torque for an acceleration of GRAVITY up to which joints count as holding no load.
"""

GRAVITY = 9.81  # m/s^2


def holding_torque(robot: Robot, dynamic: Array) -> float:
    """Return the mean torque, N m, or force, N, that the joints hold at the home pose.

    dynamic (p,): dynamic parameters. If the joints hold next to nothing, as those of a robot that
    lies flat, it is the mean of what they need to accelerate the platform by GRAVITY along each
    axis.
    """
    home = robot.home_pose
    axes = robot.geometry.chart.basis.T
    held = robot.static_torque(home, dynamic)
    lifting = GRAVITY * axes[axes[:, :3].any(axis=1)]
    rest = np.zeros_like(lifting)
    needed = robot.inverse_dynamics(np.tile(home, (len(lifting), 1)), rest, lifting, dynamic) - held
    mean = float(np.abs(held).mean())
    accelerating = float(np.abs(needed).mean())
    return mean if mean > WEIGHTLESS * accelerating else accelerating


def typical_sizes(layout: ParameterLayout, values: Array, torque: float) -> Array:
    """Return the size (p,) of each parameter: its own value or, for friction, the holding torque.

    The torque is in N m, or N. A specification says little about friction, but a joint that rubs
    more than it carries would be called broken.
    """
    return np.where(friction(layout), torque, np.where(values > 0, values, 1.0))


def friction(layout: ParameterLayout) -> NDArray[np.bool_]:
    """Return which parameters (p,) are those of friction."""
    return np.isin(layout.names, layout.coulomb_names + layout.viscous_names)
