"""Initial guess: knowledge of the parameters before the experiment.

Each parameter has a value with a standard deviation. The standard deviation is large, except for
parameters in the scenario's `[identification.prior]`.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop.drives import ABOVE_ZERO, READS, DriveName
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.loop_parameters import check_parameter_set, is_gain
from identify.scenario import Model, PriorValue
from identify.scenario.sections import Identification


@dataclass(frozen=True)
class StartingGuess:
    """Knowledge of a robot's parameters before the experiment.

    values, std (p,): values and their standard deviations, SI. drive: law of the drives. Gains that
    this law does not read are fixed at zero.
    """

    layout: ParameterLayout
    values: Array
    std: Array
    drive: DriveName = "pid"

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Marks (p,) of the gains that the law of the drives does not read."""
        names = self.layout.names
        return np.isin(names, self.layout.joint_pid_names) & ~np.isin(
            names, gains_among(self.layout, READS[self.drive])
        )

    @property
    def above_zero(self) -> tuple[str, ...]:
        """Parameters that must be above zero for a model to exist."""
        return ("platform.mass", *gains_among(self.layout, ABOVE_ZERO[self.drive]))

    @property
    def rows(self) -> Array:
        """Matrix (p, p) of the guess as equations in the parameters, in standard deviations."""
        return np.diag(1 / self.std)


def gains_among(layout: ParameterLayout, kinds: Collection[str]) -> list[str]:
    """Return the names of the gains of some kinds, such as lp."""
    return [name for name in layout.joint_pid_names if name.rpartition(".")[2] in kinds]


# Factor that makes the standard deviation of a gain negligible if the drives do not read it.
FIXED = 1e-9


def starting_guess(
    robot: Robot,
    set_name: str,
    relative_std: float,
    known: Mapping[str, PriorValue] = MappingProxyType({}),
    drive: DriveName = "pid",
) -> StartingGuess:
    """Return the initial guess that follows from a parameter set of the robot file.

    relative_std: standard deviation of each parameter, as a fraction of its size (`typical_sizes`).
    known: values and standard deviations that replace the guess for some parameters, by name.
    Raises ScenarioError if the robot has no such set, or no parameter with a name in `known`.
    """
    check_parameter_set(robot, set_name)
    chosen = robot.parameter_sets[set_name]
    torque = holding_torque(robot, chosen.dynamic)
    values = chosen.vector.copy()
    std = relative_std * typical_sizes(robot, chosen.vector, torque)
    for name, prior in known.items():
        if name not in robot.layout.names and is_gain(name):
            form = "each" if robot.layout.own_gains else "shared"
            raise ScenarioError(
                f"identification.prior: {name} is no gain of the model, whose gains are "
                f"{', '.join(robot.layout.joint_pid_names[:3])} and so on: model.gains = {form!r}"
            )
        if name not in robot.layout.names:
            raise ScenarioError(
                f"identification.prior: the model of {robot.name} has no {name}; full bodies are "
                "set by model.inertia, and friction of passive joints by model.passive_friction"
            )
        index = robot.layout.names.index(name)
        values[index] = prior.value
        std[index] = prior.std
    guess = StartingGuess(robot.layout, values, std, drive)
    # The guess refers to these arrays, so it changes with them.
    values[guess.fixed] = 0.0
    std[guess.fixed] = FIXED * std[guess.fixed]
    return guess


def model_guess(robot: Robot, model: Model, settings: Identification) -> StartingGuess:
    """Return the initial guess of a model, with the settings' prior of single parameters.

    Raises the ScenarioError of `starting_guess`.
    """
    return starting_guess(
        robot, model.start_parameters, settings.start_std, settings.prior, model.drive_law
    )


# Largest negligible holding torque, as a fraction of the torque to accelerate by GRAVITY.
WEIGHTLESS = 0.01

GRAVITY = 9.81  # m/s^2


def holding_torque(robot: Robot, dynamic: Array) -> float:
    """Return the mean absolute torque, N m, or force, N, that the joints hold at the home pose.

    dynamic (p,): dynamic parameters. If the holding torque is negligible, as for a robot in a
    horizontal plane, the result is the mean absolute torque that accelerates the platform by
    GRAVITY along one of its translational axes.
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


def typical_sizes(robot: Robot, values: Array, torque: float) -> Array:
    """Return the size (p,) of each parameter: its own value or, for friction, the holding torque.

    torque: holding torque, N m, or force, N. Data sheets rarely state friction, but friction above
    the holding torque would mean a broken joint. Friction of passive joints has the size of
    `passive_torque`. First moments and products of inertia have the sizes of `asymmetry`. The size
    of any other parameter without a positive value is 1.
    """
    layout = robot.layout
    sizes = np.where(friction(layout), torque, np.where(values > 0, values, 1.0))
    own = layout.inertial
    sizes[own] = np.where(layout.signed[own], asymmetry(robot, values), sizes[own])
    sizes[layout.passive] = passive_torque(robot, torque)
    return sizes


def passive_torque(robot: Robot, torque: float) -> float:
    """Return the typical torque, N m, of passive joints.

    torque: holding torque of the actuators, N m, or force, N, for sliding actuators.
    """
    return torque * robot.geometry.characteristic_length if robot.layout.prismatic else torque


def asymmetry(robot: Robot, values: Array) -> Array:
    """Return sizes (i,) of the first moments and products of inertia of a robot's bodies.

    The size of a first moment is the mass of the body times half its length. The size of a product
    is the mean of the moments of inertia. The sizes of all other inertial parameters are zero.
    values (p,): parameters of the robot.
    """
    layout = robot.layout
    bodies = layout.bodies_of(values)
    found = np.zeros_like(bodies)
    found[:, 1:4] = (bodies[:, 0] * robot.geometry.body_lengths / 2)[:, None]
    found[:, 7:] = bodies[:, 4:7].mean(axis=1, keepdims=True)
    return layout.rigid_of(found)


def friction(layout: ParameterLayout) -> NDArray[np.bool_]:
    """Return which parameters (p,) are the friction of actuated joints."""
    return np.isin(layout.names, layout.coulomb_names + layout.viscous_names)
