"""Troubles in the plant: geometry, springs, friction, limits and laws of the drives."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dynamics.geometry import RobotGeometry
from dynamics.parameters import passive_parameters
from identify.diagnosis.body_causes import PASSIVE_GROUP, passive_words
from identify.diagnosis.geometry_causes import GROUPS, ZEROS
from identify.experiment.plant import Plant
from identify.studies.rows.gauntlet.trouble import (
    Laboratory,
    Remedied,
    Trouble,
    log_uniform,
    sign,
    typed,
)
from identify.studies.rows.gauntlet.troubled_plants import PlantWithPlay

# Smallest and largest error of a zero, by the unit of the joints.
ZERO = {"rad": (2e-4, 1.5e-3), "m": (5e-5, 5e-4)}
# Smallest and largest error of another number of the geometry, by unit.
NUMBER = {"rad": (1e-3, 8e-3), "m": (1e-4, 8e-4)}
# Smallest and largest step to which commands are rounded, by the unit of the joints.
STEP = {"rad": (3e-4, 2e-3), "m": (3e-5, 2e-4)}
# Smallest and largest friction of passive joints, N m s/rad or N m, by its law.
PASSIVE = {"viscous": (0.01, 0.05), "coulomb": (3e-3, 2e-2)}
# Smallest and largest width of play, by the unit of the joints.
PLAY = {"rad": (5e-4, 3e-3), "m": (1e-4, 1e-3)}


def _moved_by(change: Callable[[RobotGeometry], RobotGeometry]) -> Callable[[Plant], Plant]:
    """Return a function that applies a change of geometry to the true robot of a plant."""

    def moved(plant: Plant) -> Plant:
        geometry: RobotGeometry = plant.robot.geometry
        return replace(plant, robot=plant.robot.moved(change(geometry).deviations_from(geometry)))

    return moved


def zero(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a joint whose zero is off."""
    layout = lab.robot.layout
    joint = int(rng.integers(layout.joints))
    size = sign(rng) * log_uniform(rng, *ZERO[layout.joint_unit])
    errors = (size * np.eye(layout.joints)[joint]).tolist()
    return Trouble(
        kind="zero of a joint",
        size=size,
        unit=layout.joint_unit,
        groups=("zeros of the joints",),
        cause=f"zero of joint {joint + 1}",
        settings={f"plant.joint_zero_error_{layout.joint_unit}": errors},
        remedy=typed,
    )


def geometric_number(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw an error of one number of the geometry that is not a zero of a joint."""
    geometry = lab.robot.geometry
    indices = [
        index
        for index, name in enumerate(geometry.number_names)
        if name.partition(".")[2] not in ZEROS
    ]
    index = int(rng.choice(indices))
    unit = geometry.number_units[index]
    leg, _, name = geometry.number_names[index].partition(".")
    kind = name.partition(".")[0]
    size = sign(rng) * log_uniform(rng, *NUMBER[unit])
    deviations = size * np.eye(len(geometry.number_names))[index]
    cause_name = f"{name.replace('_', ' ').replace('.', ' ')} of {leg.replace('leg', 'leg ')}"
    return Trouble(
        kind="geometry",
        size=size,
        unit=unit,
        groups=(GROUPS.get(kind, kind.replace("_", " ")),),
        cause=cause_name,
        plant=_moved_by(lambda own: own.moved(deviations)),
    )


def geometric_numbers(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw errors of 3 to 8 numbers of the geometry, all of one kind and none a joint's zero.

    The size is their root mean square.
    """
    geometry = lab.robot.geometry
    kinds: dict[str, list[int]] = {}
    for index, name in enumerate(geometry.number_names):
        number_of_leg = name.partition(".")[2]
        if number_of_leg not in ZEROS:
            kinds.setdefault(number_of_leg.partition(".")[0], []).append(index)
    kind = str(rng.choice(sorted(kinds)))
    count = int(rng.integers(3, min(8, len(kinds[kind])) + 1))
    deviations = np.zeros(len(geometry.number_names))
    for index in rng.choice(kinds[kind], size=count, replace=False):
        deviations[index] = sign(rng) * log_uniform(rng, *NUMBER[geometry.number_units[index]])
    return Trouble(
        kind="several numbers of the geometry",
        size=float(np.sqrt(np.mean(deviations[deviations != 0] ** 2))),
        unit=geometry.number_units[kinds[kind][0]],
        groups=(GROUPS.get(kind, kind.replace("_", " ")),),
        plant=_moved_by(lambda own: own.moved(deviations)),
    )


def springs(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a compliance of the joints."""
    prismatic = lab.robot.layout.prismatic
    size = log_uniform(rng, 2e-5, 1e-4) if not prismatic else log_uniform(rng, 1e-7, 1e-6)
    key = "joint_stiffness_N_m" if prismatic else "joint_stiffness_N_m_rad"
    unit = lab.robot.layout.unit("joint1.coulomb")
    return Trouble(
        kind="elastic joints",
        size=size,
        unit=f"{lab.robot.layout.joint_unit}/({unit})",
        groups=("elasticity of the joints",),
        cause="elasticity of the joints",
        settings={f"plant.{key}": 1.0 / size},
    )


def static_friction(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw static friction that exceeds Coulomb friction."""
    key = _velocity_key(lab, "stribeck_velocity")
    size = log_uniform(rng, 0.03, 0.3)
    return Trouble(
        kind="static friction",
        size=size,
        unit="1",
        groups=("law of friction",),
        settings={
            "plant.friction": "stribeck",
            "plant.static_ratio": 1.0 + size,
            f"plant.{key}": log_uniform(rng, 0.02, 0.1) * _per_unit(lab),
        },
        remedy=typed,
    )


def smooth_friction(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw friction that is smooth about rest."""
    key = _velocity_key(lab, "smoothing_velocity")
    size = log_uniform(rng, 3e-3, 3e-2) * _per_unit(lab)
    return Trouble(
        kind="smooth friction",
        size=size,
        unit=f"{lab.robot.layout.joint_unit}/s",
        groups=("law of friction",),
        cause="friction that is smooth about rest",
        settings={"plant.friction": "smoothed", f"plant.{key}": size},
        remedy=typed,
    )


def _velocity_key(lab: Laboratory, name: str) -> str:
    return f"{name}_{'m' if lab.robot.layout.prismatic else 'rad'}_s"


def _per_unit(lab: Laboratory) -> float:
    """Return the factor from typical velocities of revolute joints, rad/s, to those of this robot.

    It is 0.1 for prismatic joints, m/s.
    """
    return 0.1 if lab.robot.layout.prismatic else 1.0


def passive_friction(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw friction of one law in the corresponding passive joint of every leg."""
    name = str(rng.choice(passive_parameters(lab.robot.geometry.legs)))
    size = log_uniform(rng, *PASSIVE[name.partition(".")[2]])
    return Trouble(
        kind="passive friction",
        size=size,
        unit=lab.robot.layout.unit(name),
        groups=(PASSIVE_GROUP,),
        cause=passive_words(name),
        settings={"plant.passive_friction": [name], "plant.values": {name: size}},
        remedy=typed,
    )


def torque_limit(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a torque limit of the drives that cuts off the largest torques."""
    # the drives can hold the robot, but cannot reach the torques of the fastest motion
    limit = lab.holding + rng.uniform(0.75, 0.92) * (lab.peak - lab.holding)
    size = 1.0 - limit / lab.peak
    unit = lab.robot.layout.unit("joint1.coulomb").replace(" ", "_")
    settings = {f"control.torque_limit_{unit}": float(limit)}
    return Trouble(
        kind="torque limit",
        size=size,
        unit="1",
        groups=("torque limit of the drives",),
        settings=settings,
        # the limit is read from the drives, because a record shows it only up to the model's scale
        remedy=lambda finding: Remedied(settings),
    )


def cascade(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Return cascade drives. Nothing is drawn, because a cascade has no size."""
    return Trouble(
        kind="cascade drives",
        size=1.0,
        unit="",
        groups=("law of the drives",),
        settings={"plant.drive": "cascade"},
        remedy=typed,
    )


def backlash(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw play between commands and drives. The diagnosis has no such cause."""
    unit = lab.robot.layout.joint_unit
    size = log_uniform(rng, *PLAY[unit])
    return Trouble(
        kind="backlash",
        size=size,
        unit=unit,
        groups=(),
        plant=lambda plant: PlantWithPlay(**vars(plant), width=size),
    )


def quantised(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw drives that round their commands to steps. The diagnosis has no such cause."""
    unit = lab.robot.layout.joint_unit
    size = log_uniform(rng, *STEP[unit])

    def stepped(plant: Plant) -> Plant:
        drives = replace(plant.settings.drives, command_step=size)
        return replace(plant, settings=replace(plant.settings, drives=drives))

    return Trouble(kind="steps of commands", size=size, unit=unit, groups=(), plant=stepped)


def unequal_gains(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a joint, not the first, whose proportional gain differs from that of all others."""
    layout = lab.robot.layout
    joint = int(rng.integers(1, layout.joints))
    gain = float(lab.parameters[layout.names.index("joint_pid.lp")])
    size = sign(rng) * log_uniform(rng, 0.03, 0.2) * gain
    return Trouble(
        kind="unequal gains",
        size=size,
        unit=layout.unit("joint_pid.lp"),
        groups=("gains that differ between joints",),
        cause=f"lp of joint {joint + 1}, beyond that of joint 1",
        settings={
            "plant.gains": "each",
            "plant.values": {f"joint{joint + 1}.lp": gain + size},
        },
        remedy=typed,
    )
