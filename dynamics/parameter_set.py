"""Parameter sets of a robot file: bodies, joint friction and gains of the joint PID.

A file also states how far real bodies and joints may be from the model (`Unstated`).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from dynamics.checks import Damping, FirstMoment, Force, Gain, Inertia, Mass, Product
from dynamics.errors import RobotFileError
from dynamics.parameters import JOINT_PID, ParameterLayout
from dynamics.pseudo_inertia import body_fault
from dynamics.spatial_inertia import FULL_INERTIAL, INERTIAL


class Strict(BaseModel):
    """Section of a robot file, in which every key must be known."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _know_every_key(cls, values: object) -> object:
        """Raise ValueError, with the valid keys, for an unknown key."""
        unknown = sorted(set(values) - set(cls.model_fields)) if isinstance(values, dict) else []
        if unknown:
            raise ValueError(
                f"unknown key {', '.join(unknown)}; valid: {', '.join(cls.model_fields)}"
            )
        return values


class BodyInertia(Strict):
    """Mass, kg, and moments of inertia about the body's own axes, kg m^2.

    A full body also has the first moments of its mass, kg m, and products of inertia, kg m^2. All
    moments and products are about the reference point of the body, which is the centre of mass of a
    body without first moments. Each entry is one value, or a list with one value per leg.
    """

    mass: Mass | list[Mass]
    mcx: FirstMoment | list[FirstMoment] = 0.0
    mcy: FirstMoment | list[FirstMoment] = 0.0
    mcz: FirstMoment | list[FirstMoment] = 0.0
    Ixx: Inertia | list[Inertia]
    Iyy: Inertia | list[Inertia]
    Izz: Inertia | list[Inertia]
    Ixy: Product | list[Product] = 0.0
    Ixz: Product | list[Product] = 0.0
    Iyz: Product | list[Product] = 0.0


class Friction(Strict):
    """Dry friction, N m or N, and viscous friction, N m s/rad or N s/m, of the actuated joints.

    Each is one value, or a list with one value per leg.
    """

    coulomb: Force | list[Force]
    viscous: Damping | list[Damping]


class PassiveFriction(Strict):
    """Dry friction, N m, and viscous friction, N m s/rad, of a passive joint. None means zero."""

    coulomb: Force | None = None
    viscous: Damping | None = None


class JointPid(Strict):
    """Gains of the joint PID. Each is one value that all joints share, or a list with one per leg.

    `unit` is the unit of lp. It must be stated if the actuators slide.
    """

    lp: Gain | list[Gain]
    li: Gain | list[Gain]
    ld: Gain | list[Gain]
    unit: Literal["N m/rad", "N/m"] | None = None


class Parameters(BaseModel):
    """Set of parameters: platform, joints, gains, and a table for each kind of leg body."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, BodyInertia] = Field(init=False)

    platform: BodyInertia
    joint: Friction
    joint_pid: JointPid
    passive: dict[str, PassiveFriction] = Field(
        {},
        description="friction of passive joints, each named by the body outwards from it: "
        "{ link_joint = { viscous = 0.005 }, platform_joint = { coulomb = 0.02 } }; or in single "
        "legs: { link3_joint = { viscous = 0.01 } }",
    )

    @property
    def passive_values(self) -> dict[str, float]:
        """Values of the stated friction of passive joints, by parameter name."""
        return {
            f"{joint}.{law}": value
            for joint, friction in self.passive.items()
            for law, value in friction.model_dump(exclude_none=True).items()
        }

    @property
    def own_gains(self) -> bool:
        """True if a gain has one value per leg."""
        return any(isinstance(getattr(self.joint_pid, gain), list) for gain in JOINT_PID)


class Unstated(Strict):
    """Standard deviations of the differences between real bodies and joints and the model.

    In the model, a centred body has its centre of mass at the reference point, and its principal
    axes of inertia along its own axes. A passive joint without a viscous parameter turns freely.
    Real bodies and joints differ from this model. The defaults are for an ordinary workshop. Zero
    states that bodies and joints are exactly as modelled.
    """

    centre_std: float = Field(
        0.03,
        description="of each coordinate of a centre of mass, as a share of the length of the body",
        ge=0,
        le=1,
    )
    product_std: float = Field(
        0.05,
        description="of each product of inertia, as a share of the body's mean moment of inertia",
        ge=0,
        le=1,
    )
    passive_viscous_std: Damping = Field(
        0.005, description="of the viscous friction of a passive joint, N m s/rad"
    )


# Bodies and joints that are exactly as modelled.
EXACT = Unstated(centre_std=0.0, product_std=0.0, passive_viscous_std=0.0)


@dataclass(frozen=True)
class ParameterSet:
    """Parameter set of a robot.

    `dynamic` (p,) is in the order of `Robot.parameter_names`. `joint_pid` has lp, li, ld: (3,) if
    all joints share them, or (3 n,) joint by joint.
    """

    dynamic: np.ndarray
    joint_pid: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """All values: the dynamic parameters, then the gains."""
        return np.concatenate([self.dynamic, self.joint_pid])


def parameter_set(name: str, values: Parameters, layout: ParameterLayout) -> ParameterSet:
    """Parameter set from its section of a robot file.

    Raises RobotFileError, with the entry, for unknown and missing bodies, for lists of a wrong
    length, for bodies that cannot exist, and for gains in a wrong unit. Raises ParameterError for a
    platform without mass.
    """

    def per_leg(key: str, value: float | list[float], count: int) -> list[float]:
        """One value for each of `count` legs."""
        expanded = value if isinstance(value, list) else [value] * count
        if len(expanded) != count:
            raise RobotFileError(
                f"parameters.{name}.{key} needs one value or {count} values, got {len(expanded)}"
            )
        return expanded

    kinds = [kind.name for kind in layout.kinds]
    inertias = {"platform": values.platform, **(values.model_extra or {})}
    if set(inertias) != set(kinds):
        wrong = sorted(set(inertias) ^ set(kinds))
        valid = ", ".join([*dict.fromkeys(kinds), "joint", "joint_pid"])
        raise RobotFileError(
            f"parameters.{name}: {', '.join(wrong)} unknown or missing; it needs {valid}"
        )
    bodies = np.empty((len(kinds), len(FULL_INERTIAL)))
    for kind, inertia in inertias.items():
        rows = [row for row, name_of in enumerate(kinds) if name_of == kind]
        bodies[rows] = np.transpose(
            [per_leg(f"{kind}.{k}", v, len(rows)) for k, v in inertia.model_dump().items()]
        )
    _check_bodies(name, bodies, layout)
    friction = [
        per_leg(f"joint.{key}", value, layout.joints)
        for key, value in values.joint.model_dump().items()
    ]
    passive = [values.passive_values.get(name, 0.0) for name in layout.passive_names]
    dynamic = layout.check(np.concatenate([layout.rigid_of(bodies), passive, *friction]))
    stated = values.joint_pid.unit
    unit = layout.unit(layout.joint_pid_names[0])
    columns = [
        per_leg(f"joint_pid.{gain}", getattr(values.joint_pid, gain), layout.joints)
        for gain in JOINT_PID
    ]
    if stated != unit and (stated or layout.prismatic):
        raise RobotFileError(
            f"parameters.{name}.joint_pid.lp = {columns[0][0]:g} "
            f"{f'is in {stated}' if stated else 'has no unit'}, but the actuators "
            f"{'slide' if layout.prismatic else 'turn'}: their gains are in {unit}, which is "
            f'stated by unit = "{unit}" in joint_pid'
        )
    each = np.transpose(columns)
    joint_pid = np.array(each.reshape(-1) if layout.own_gains else each[0])
    for array in (dynamic, joint_pid):
        array.setflags(write=False)
    return ParameterSet(dynamic, joint_pid)


def _check_bodies(set_name: str, bodies: np.ndarray, layout: ParameterLayout) -> None:
    """Raise RobotFileError for a full body (10,) that cannot exist.

    Raises it also for a centred body that has first moments or products of inertia.
    """
    for body, full, row in zip(layout.bodies, layout.full, bodies, strict=True):
        where = f"parameters.{set_name}: {body}"
        if full and (fault := body_fault(row)):
            raise RobotFileError(f"{where} cannot exist: {fault} (kg, m, kg m^2)")
        for name, value in zip(FULL_INERTIAL, row, strict=True):
            if not full and value and name not in INERTIAL:
                raise RobotFileError(
                    f"{where}.{name} = {value:g}, but {body} is centred; a full body has "
                    f'{name}: inertia = "full", or inertia = {{ {body} = "full" }}'
                )
