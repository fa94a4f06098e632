"""Dynamic parameters of a robot: names, order, units and physical range (Xi of eq. 25).

The paper calls the driven arm of a leg its wrench. Here it is the crank.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import Shape, floats
from dynamics.errors import ParameterError
from dynamics.legs.leg import INERTIAL, Body, Leg

PLATFORM = Body("platform", ("Ixx", "Iyy", "Izz"))
JOINT_PID = ("lp", "li", "ld")


LANES = 8
"""Number of derivatives that are computed at once."""


def room_for_derivatives(parameters: int, start: int) -> int:
    """Number of columns for the derivatives of one number, a multiple of LANES.

    The columns are for the parameters, the length of a step and the entries of a start.
    """
    return -(-(parameters + 1 + start) // LANES) * LANES


@dataclass(frozen=True, eq=False)
class RigidGroups:
    """Combinations (k, r) of the r inertial parameters of a robot on which its motion depends.

    `pivots` (k,) are one parameter of each combination, ascending. It has the coefficient 1 there,
    and is in no other combination.
    """

    pivots: np.ndarray
    combinations: np.ndarray

    def of_all(self, by_pivots: np.ndarray) -> np.ndarray:
        """Derivatives (..., p) with respect to all parameters.

        `by_pivots` are derivatives with respect to the pivots and to the parameters after the
        inertial ones.
        """
        count = len(self.pivots)
        return np.concatenate(
            [by_pivots[..., :count] @ self.combinations, by_pivots[..., count:]], axis=-1
        )


@dataclass(frozen=True)
class ParameterLayout:
    """Parameters of a robot: of its bodies, of joint friction, and of the joint PID.

    `bodies` are all bodies, the platform first, with the kind of each. `of_leg` are the places of
    the bodies of each leg among them. `prismatic` is True where actuators slide.
    """

    bodies: tuple[str, ...]
    kinds: tuple[Body, ...]
    of_leg: tuple[tuple[int, ...], ...]
    prismatic: bool

    @property
    def joints(self) -> int:
        """Number of actuated joints."""
        return len(self.of_leg)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints."""
        return tuple(f"joint{leg}" for leg in range(1, self.joints + 1))

    @cached_property
    def rigid_names(self) -> tuple[str, ...]:
        """Names of the inertial parameters: mass and moments, body by body."""
        return tuple(f"{body}.{name}" for body in self.bodies for name in INERTIAL)

    @cached_property
    def coulomb_names(self) -> tuple[str, ...]:
        """Names of the dry friction of the joints."""
        return tuple(f"{joint}.coulomb" for joint in self.joint_names)

    @cached_property
    def viscous_names(self) -> tuple[str, ...]:
        """Names of the viscous friction of the joints."""
        return tuple(f"{joint}.viscous" for joint in self.joint_names)

    @cached_property
    def joint_pid_names(self) -> tuple[str, ...]:
        """Names of the gains of the joint PID, which all joints share."""
        return tuple(f"joint_pid.{gain}" for gain in JOINT_PID)

    @cached_property
    def dynamic_names(self) -> tuple[str, ...]:
        """Names of the dynamic parameters, in which the equation of motion is linear."""
        return self.rigid_names + self.coulomb_names + self.viscous_names

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: the dynamic ones, then lp, li, ld."""
        return self.dynamic_names + self.joint_pid_names

    def derivatives(self, coordinates: int) -> int:
        """Number of columns for the derivatives of one number of the loop."""
        return room_for_derivatives(len(self.names), 3 * coordinates + self.joints)

    @property
    def rigid(self) -> slice:
        """Place of the inertial parameters."""
        return slice(0, len(self.rigid_names))

    @property
    def coulomb(self) -> slice:
        """Place of the dry friction."""
        return slice(self.rigid.stop, self.rigid.stop + self.joints)

    @property
    def viscous(self) -> slice:
        """Place of the viscous friction."""
        return slice(self.coulomb.stop, self.coulomb.stop + self.joints)

    @property
    def dynamic(self) -> slice:
        """Place of the dynamic parameters."""
        return slice(0, self.viscous.stop)

    @property
    def joint_pid(self) -> slice:
        """Place of the gains."""
        return slice(self.viscous.stop, self.viscous.stop + len(JOINT_PID))

    def bodies_of(self, rigid: np.ndarray) -> np.ndarray:
        """View of the inertial parameters with one row (mass, Ixx, Iyy, Izz) a body."""
        return rigid[..., self.rigid].reshape(*rigid.shape[:-1], len(self.bodies), len(INERTIAL))

    def leg_rows(self, leg: int) -> list[int]:
        """Places of the inertial parameters of a leg's bodies, one body after the other."""
        return [
            len(INERTIAL) * body + entry
            for body in self.of_leg[leg]
            for entry in range(len(INERTIAL))
        ]

    @property
    def joint_unit(self) -> str:
        """Unit of the joint coordinates."""
        return "m" if self.prismatic else "rad"

    def unit(self, name: str) -> str:
        """Unit of a parameter, such as `crank1.mass` or `joint_pid.lp`.

        Units of friction and gains follow the actuators.
        """
        return unit_of(name, self.prismatic)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Parameters as those of rigid bodies, dry and viscous friction, and lp, li, ld (3,)."""
        return (
            values[self.rigid],
            values[self.coulomb],
            values[self.viscous],
            values[self.joint_pid],
        )

    def check(self, values: ArrayLike, *, batch: bool = False) -> np.ndarray:
        """Dynamic parameters as floats (p,), or (N, p) where a batch is allowed.

        Raises ParameterError for another shape, for a value that is NaN, infinite or negative, and
        for a platform without mass. The message has the parameter with its value, unit and limit,
        and its row in a batch.
        """
        count = len(self.dynamic_names)
        shapes: list[Shape] = [(count,), ("N", count)]
        parameters = floats(
            "parameters", values, *shapes[: 1 + batch], error=ParameterError, finite=False
        )
        allowed = (parameters >= 0) & (parameters < np.inf)
        allowed[..., 0] &= parameters[..., 0] > 0
        if allowed.all():
            return parameters
        place = tuple(int(index) for index in np.argwhere(~allowed)[0])
        name = self.dynamic_names[place[-1]]
        limit = ">= 0" if place[-1] else "> 0"
        where = f" (row {place[0]})" if len(place) > 1 else ""
        raise ParameterError(
            f"{name} = {parameters[place]:g} {self.unit(name)} is not allowed, must be finite and "
            f"{limit}{where}"
        )


def parameter_layout(legs: Sequence[Leg]) -> ParameterLayout:
    """Layout of a robot with these legs.

    The platform is first. Then come the first bodies of all legs, then the second ones.
    """
    found: list[tuple[int, Body]] = []
    for place in range(max(len(leg.bodies) for leg in legs)):
        found += [
            (number, leg.bodies[place])
            for number, leg in enumerate(legs)
            if place < len(leg.bodies)
        ]
    of_leg = [
        tuple(1 + k for k, (owner, _) in enumerate(found) if owner == number)
        for number in range(len(legs))
    ]
    names = tuple(f"{body.name}{number + 1}" for number, body in found)
    kinds = tuple(body for _, body in found)
    return ParameterLayout(
        ("platform", *names), (PLATFORM, *kinds), tuple(of_leg), legs[0].prismatic
    )


UNITS = {"mass": "kg", "Ixx": "kg m^2", "Iyy": "kg m^2", "Izz": "kg m^2"}
REVOLUTE = {
    "coulomb": "N m",
    "viscous": "N m s/rad",
    "lp": "N m/rad",
    "li": "N m/(rad s)",
    "ld": "N m s/rad",
}
PRISMATIC = {"coulomb": "N", "viscous": "N s/m", "lp": "N/m", "li": "N/(m s)", "ld": "N s/m"}


def unit_of(name: str, prismatic: bool = False) -> str:
    """Unit of a parameter name such as `crank1.mass` or `joint_pid.lp`."""
    return (UNITS | (PRISMATIC if prismatic else REVOLUTE))[name.rsplit(".", 1)[1]]
