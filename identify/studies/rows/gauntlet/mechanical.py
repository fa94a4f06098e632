"""Troubles in the plant: geometry, springs, bodies, friction, limits and laws of the drives."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dynamics.geometry import RobotGeometry
from identify.arrays import Array
from identify.diagnosis.geometry_causes import GROUPS, ZEROS
from identify.experiment.plant import Plant
from identify.studies.rows.gauntlet.play import PlantWithPlay
from identify.studies.rows.gauntlet.trouble import Laboratory, Trouble, log_uniform, sign
from identify.studies.rows.gauntlet.typed import stated, typed

ZERO = {"rad": (2e-4, 1.5e-3), "m": (5e-5, 5e-4)}
"""Smallest and largest error of a zero, by the unit of the joints."""

NUMBER = {"rad": (1e-3, 8e-3), "m": (1e-4, 8e-4)}
"""Smallest and largest error of another number of the geometry, by unit."""

PLAY = {"rad": (5e-4, 3e-3), "m": (1e-4, 1e-3)}
"""Smallest and largest width of play, by the unit of the joints."""


def _moved_by(change: Callable[[RobotGeometry], RobotGeometry]) -> Callable[[Plant], Plant]:
    """Return the change of a plant whose true geometry is changed."""

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


def number(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a number of the geometry that is off, other than a zero."""
    geometry = lab.robot.geometry
    places = [
        place
        for place, name in enumerate(geometry.number_names)
        if name.partition(".")[2] not in ZEROS
    ]
    place = int(rng.choice(places))
    unit = geometry.number_units[place]
    leg, _, name = geometry.number_names[place].partition(".")
    kind = name.partition(".")[0]
    size = sign(rng) * log_uniform(rng, *NUMBER[unit])
    deviations = size * np.eye(len(geometry.number_names))[place]
    words = f"{name.replace('_', ' ').replace('.', ' ')} of {leg.replace('leg', 'leg ')}"
    return Trouble(
        kind="geometry",
        size=size,
        unit=unit,
        groups=(GROUPS.get(kind, kind.replace("_", " ")),),
        cause=words,
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
    """Draw static friction above that of Coulomb."""
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
    """Return how much slower joints that slide are than joints that turn, as numbers in SI."""
    return 0.1 if lab.robot.layout.prismatic else 1.0


def torque_limit(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw drives that cut the largest torques."""
    # the drives still hold the robot, and lack what the fastest motion needs
    limit = lab.holding + rng.uniform(0.75, 0.92) * (lab.peak - lab.holding)
    size = 1.0 - limit / lab.peak
    unit = lab.robot.layout.unit("joint1.coulomb").replace(" ", "_")
    return Trouble(
        kind="torque limit",
        size=size,
        unit="1",
        groups=("torque limit of the drives",),
        settings={f"control.torque_limit_{unit}": float(limit)},
        remedy=stated,
    )


def cascade(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Return drives that are a cascade. They are there or not, so that nothing is drawn."""
    return Trouble(
        kind="cascade drives",
        size=1.0,
        unit="",
        groups=("law of the drives",),
        settings={"plant.drive": "cascade"},
        remedy=typed,
    )


def centre_of_mass(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a centre of mass of the platform that is off its frame's origin."""
    size = log_uniform(rng, 8e-3, 4e-2)
    direction = rng.standard_normal(3)
    centre = size * direction / np.linalg.norm(direction)
    mass, *moments = (_of_platform(lab, name) for name in ("mass", "Ixx", "Iyy", "Izz"))
    return Trouble(
        kind="centre of mass",
        size=size,
        unit="m",
        groups=("centre of mass of the platform",),
        settings={"plant.values": _platform(mass, centre, np.diag(possible_moments(moments)))},
        remedy=typed,
    )


def products_of_inertia(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw principal axes of the platform that are turned in its frame."""
    mass, *moments = (_of_platform(lab, name) for name in ("mass", "Ixx", "Iyy", "Izz"))
    size = log_uniform(rng, 0.25, 0.6)
    principal = np.diag(possible_moments(moments))
    share = size * rng.uniform(-1.0, 1.0, 3)
    mean = float(np.trace(principal)) / 3
    products = np.zeros((3, 3))
    products[[0, 0, 1], [1, 2, 2]] = mean * share
    inertia = 1.2 * principal + products + products.T
    return Trouble(
        kind="products of inertia",
        size=size,
        unit="1",
        groups=("products of inertia of the platform",),
        settings={"plant.values": _platform(mass, np.zeros(3), _rigid(inertia))},
        remedy=typed,
    )


def _of_platform(lab: Laboratory, name: str) -> float:
    return float(lab.parameters[lab.robot.layout.names.index(f"platform.{name}")])


def possible_moments(moments: list[float]) -> Array:
    """Return moments (3,) of a body that exists, at least as large as those given.

    The smaller two are raised until they exceed the largest one together by a tenth.
    """
    found = np.array(moments)
    order = np.argsort(found)
    smaller = order[:2]
    found[smaller] *= max(1.0, 1.1 * found[order[2]] / found[smaller].sum())
    return found


def _rigid(inertia: Array) -> Array:
    """Return an inertia (3, 3) that a body can have, near one that perhaps none can have."""
    principal, axes = np.linalg.eigh(inertia)
    return np.asarray(axes @ np.diag(possible_moments(principal.tolist())) @ axes.T)


def _platform(mass: float, centre: Array, inertia: Array) -> dict[str, float]:
    """Return the parameters of a platform with a centre of mass (3,) and an inertia (3, 3) there.

    Parameters are about the origin of the platform's frame.
    """
    about = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    first = dict(zip(("mcx", "mcy", "mcz"), mass * centre, strict=True))
    places = {"Ixx": (0, 0), "Iyy": (1, 1), "Izz": (2, 2), "Ixy": (0, 1), "Ixz": (0, 2)}
    second = {name: about[place] for name, place in (places | {"Iyz": (1, 2)}).items()}
    return {f"platform.{name}": float(value) for name, value in (first | second).items()}


def backlash(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw play between commands and drives, of which the diagnosis has no cause."""
    unit = lab.robot.layout.joint_unit
    size = log_uniform(rng, *PLAY[unit])
    return Trouble(
        kind="backlash",
        size=size,
        unit=unit,
        groups=(),
        plant=lambda plant: PlantWithPlay(**vars(plant), width=size),
    )


def unequal_gains(lab: Laboratory, rng: np.random.Generator) -> Trouble:
    """Draw a joint whose proportional gain differs from that of all others."""
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
