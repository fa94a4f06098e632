"""Prior: what is known beside the poses.

Starting guess. Each parameter has a standard deviation before the experiment. It is wide, but for
parameters of which a scenario's `[identification.prior]` knows more.

Scale anchor. Multiplying every dynamic parameter and the three PID gains by the same number changes
no pose of the closed loop (eq. 17 and 31). This common factor, which poses alone leave free, is
fixed by one of

    platform_mass   the platform was weighed
    joint_gain      the proportional gain of the joint PID is known
    payload         a second run with a known load on the platform (`identify.record.conditions`);
                    the standard deviations of the load stand with that run, and widen the intervals
                    (`covariance`)
    prior           nothing but the starting guess, with its standard deviations
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop.drives import ABOVE_ZERO, READS, DriveName
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import as_number, shown
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


MEASURED_PARAMETER = {"platform_mass": "platform.mass", "joint_gain": "joint_pid.lp"}
"""Parameter that an anchor measures, by the anchor's name."""

ANCHORS = (*MEASURED_PARAMETER, "payload", "prior")

DEFAULT_STD = {"kg": 0.005, "N m/rad": 0.01, "N/m": 5.0}
"""Standard deviation of an ordinary instrument, by units.

It is that of a platform balance, kg, or of a gain read from the controller's data.
"""


def default_std(name: str, layout: ParameterLayout) -> float:
    """Return the standard deviation, SI, of an ordinary instrument for an anchor of a robot."""
    return DEFAULT_STD[layout.unit(MEASURED_PARAMETER[name])]


@dataclass(frozen=True)
class ScaleAnchor:
    """Measurement that fixes the scale.

    value and std are those of a parameter that was measured on its own, SI, or else None.
    """

    name: str
    value: float | None = None
    std: float | None = None

    def row(self, layout: ParameterLayout) -> tuple[Array, Array]:
        """Return the measurement as equations, in standard deviations.

        They are rows (k, p) and a right side (k,), with k = 0 if no parameter was measured, or else
        1.
        """
        if self.value is None or self.std is None:
            return np.zeros((0, len(layout.names))), np.zeros(0)
        row = np.zeros((1, len(layout.names)))
        row[0, layout.names.index(MEASURED_PARAMETER[self.name])] = 1 / self.std
        return row, np.array([self.value / self.std])


def measured_anchor(
    name: str, std: float | None, layout: ParameterLayout, true: Array, rng: np.random.Generator
) -> ScaleAnchor:
    """Return the anchor as an experimenter measures it.

    std: standard deviation of the instrument, None for the usual one. true (p,): true parameters of
    the robot.
    """
    if name not in MEASURED_PARAMETER:
        # nothing is measured here: a load stands with the run that was made under it
        return ScaleAnchor(name)
    spread = default_std(name, layout) if std is None else std
    measured = true[layout.names.index(MEASURED_PARAMETER[name])]
    return ScaleAnchor(name, float(measured + spread * rng.standard_normal()), spread)


def store_anchor(record: xr.Dataset, anchor: ScaleAnchor) -> None:
    """Store the anchor's measurement with the record."""
    record.attrs["scale_anchor"] = anchor.name
    if anchor.value is not None and anchor.std is not None:
        record.attrs |= {"scale_anchor_value": anchor.value, "scale_anchor_std": anchor.std}


def read_anchor(record: xr.Dataset, layout: ParameterLayout) -> ScaleAnchor:
    """Return the anchor's measurement of a robot's record.

    Raises RecordError if the record has none, so that the scale of its parameters is free, or if
    its value or standard deviation is no finite number > 0.
    """
    name = record.attrs.get("scale_anchor")
    if name not in ANCHORS:
        raise RecordError(
            "the record holds no scale anchor (attributes scale_anchor, scale_anchor_value, "
            f"scale_anchor_std), found {shown(name)}; valid anchors: {', '.join(ANCHORS)}"
        )
    if name not in MEASURED_PARAMETER:
        return ScaleAnchor(str(name))
    value, std = (_positive(record, f"scale_anchor_{what}", layout) for what in ("value", "std"))
    return ScaleAnchor(str(name), value, std)


def _positive(record: xr.Dataset, attribute: str, layout: ParameterLayout) -> float:
    """Return a record's attribute, which must be a finite number > 0."""
    value = record.attrs.get(attribute)
    number = as_number(value)
    if not 0 < number < np.inf:
        anchor = record.attrs["scale_anchor"]
        measured = MEASURED_PARAMETER[anchor]
        raise RecordError(
            f"the record's attribute {attribute} is {shown(value)}, must be a finite number > 0 in "
            f"{layout.unit(measured)}: the scale anchor {anchor} measures {measured}"
        )
    return number
