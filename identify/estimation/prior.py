"""The prior: what is known beside the poses, as residuals that join theirs.

That is the starting guess, each parameter with its standard deviation (wide, but for single ones of
which a scenario's `[identification.prior]` knows more), and the scale anchor.
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
from identify.estimation.scale_anchor import ScaleAnchor
from identify.loop_parameters import check_parameter_set
from identify.scenario import PriorValue, Scenario


@dataclass(frozen=True)
class StartingGuess:
    """What is known before the experiment of a robot's parameters: values (p,) and standard
    deviations (p,), SI; the law of its drives, which fixes the gains that it does not read at zero.
    """

    layout: ParameterLayout
    values: Array
    std: Array
    drive: DriveName = "pid"

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Gains (p,) that the law of the drives does not read."""
        read = [f"joint_pid.{gain}" for gain in READS[self.drive]]
        return np.isin(self.layout.names, self.layout.joint_pid_names) & ~np.isin(
            self.layout.names, read
        )

    @property
    def above_zero(self) -> tuple[str, ...]:
        """Parameters without which there is no model."""
        return ("platform.mass", *(f"joint_pid.{gain}" for gain in ABOVE_ZERO[self.drive]))

    @property
    def rows(self) -> Array:
        """What it says as equations of the parameters, in standard deviations (p, p)."""
        return np.diag(1 / self.std)


FIXED = 1e-9
"""Standard deviation of a gain that the law of the drives does not read, in those of the others."""


def starting_guess(
    robot: Robot,
    set_name: str,
    relative_std: float,
    known: Mapping[str, PriorValue] = MappingProxyType({}),
    drive: DriveName = "pid",
) -> StartingGuess:
    """The named parameter set of the robot file, uncertain by a fraction of each parameter's size,
    but for those of which a value and its standard deviation are known.

    Raises ScenarioError: no such set (with the valid names).
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
    values[guess.fixed] = 0.0
    std[guess.fixed] = FIXED * std[guess.fixed]
    return guess


def model_guess(robot: Robot, scenario: Scenario) -> StartingGuess:
    """The starting guess of a scenario's model. Raises as `starting_guess`."""
    settings = scenario.identification
    model = scenario.model
    return starting_guess(
        robot, model.start_parameters, settings.start_std, settings.prior, model.drive_law
    )


WEIGHTLESS = 0.01
"""Share of the torque for an acceleration of GRAVITY that joints must hold for their load to count
as held by them.
"""

GRAVITY = 9.81  # m/s^2


def holding_torque(robot: Robot, dynamic: Array) -> float:
    """Mean torque [N m] or force [N] that the joints hold at the home pose, with dynamic parameters
    (p,).

    Where they hold next to nothing, as those of a robot that lies flat, it is the mean of what they
    need to accelerate the platform by that of gravity along each axis.
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
    """Size (p,) of each parameter: its own value, and for friction the torque [N m] or force [N]
    that the joints hold.

    A specification says little about friction; a joint that rubs more than it carries would be
    called broken.
    """
    return np.where(friction(layout), torque, np.where(values > 0, values, 1.0))


def friction(layout: ParameterLayout) -> NDArray[np.bool_]:
    """Whether each parameter (p,) is one of friction."""
    return np.isin(layout.names, layout.coulomb_names + layout.viscous_names)


def prior_residuals(
    parameters: Array, guess: StartingGuess, anchor: ScaleAnchor
) -> tuple[Array, Array]:
    """Residuals (k,) of what is known beside the poses, in standard deviations, and their rows (k,
    p).
    """
    place, measured = anchor.row(guess.layout)
    rows = np.vstack([guess.rows, place])
    values = np.concatenate([guess.values / guess.std, measured])
    return rows @ parameters - values, rows
