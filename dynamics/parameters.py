"""The dynamic parameters of a robot: their names, order, units and physical range (the paper's vector Xi, eq. 25).

The paper calls the driven arm of a leg its wrench; here it is the crank.
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
"""Derivatives that are computed at once."""


def room_for_derivatives(parameters: int, start: int) -> int:
    """Of one number by the parameters, the length of a step and the entries of a start: a multiple of LANES."""
    return -(-(parameters + 1 + start) // LANES) * LANES


@dataclass(frozen=True, eq=False)
class RigidGroups:
    """Through which combinations (k, r) alone the r inertial parameters of a robot act; pivots (k,): a parameter of
    each, ascending, that has the coefficient 1 there and is in no other."""

    pivots: np.ndarray
    combinations: np.ndarray

    def of_all(self, by_pivots: np.ndarray) -> np.ndarray:
        """Derivatives (..., p) by all parameters, of those by the pivots and what stands behind the inertial ones."""
        count = len(self.pivots)
        return np.concatenate([by_pivots[..., :count] @ self.combinations, by_pivots[..., count:]], axis=-1)


@dataclass(frozen=True)
class ParameterLayout:
    """Which parameters a robot has: those of its bodies, dry and viscous friction of its joints, and the joint PID.

    bodies: all of them, the platform first, and the kind of each; of_leg: where the bodies of each leg stand in that;
    prismatic: whether actuators slide.
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
        """Of the inertial parameters: mass and moments, body by body."""
        return tuple(f"{body}.{name}" for body in self.bodies for name in INERTIAL)

    @cached_property
    def coulomb_names(self) -> tuple[str, ...]:
        """Of the dry friction of the joints."""
        return tuple(f"{joint}.coulomb" for joint in self.joint_names)

    @cached_property
    def viscous_names(self) -> tuple[str, ...]:
        """Of the viscous friction of the joints."""
        return tuple(f"{joint}.viscous" for joint in self.joint_names)

    @cached_property
    def joint_pid_names(self) -> tuple[str, ...]:
        """Of the gains of the joint PID, which all joints share."""
        return tuple(f"joint_pid.{gain}" for gain in JOINT_PID)

    @cached_property
    def dynamic_names(self) -> tuple[str, ...]:
        """Of the dynamic parameters, which the equation of motion is linear in."""
        return self.rigid_names + self.coulomb_names + self.viscous_names

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all: the dynamic parameters, then lp, li, ld."""
        return self.dynamic_names + self.joint_pid_names

    def derivatives(self, coordinates: int) -> int:
        """Room for the derivatives of one number of the loop, of a platform with so many coordinates."""
        return room_for_derivatives(len(self.names), 3 * coordinates + self.joints)

    @property
    def rigid(self) -> slice:
        """Where the inertial parameters stand."""
        return slice(0, len(self.rigid_names))

    @property
    def coulomb(self) -> slice:
        """Where dry friction stands."""
        return slice(self.rigid.stop, self.rigid.stop + self.joints)

    @property
    def viscous(self) -> slice:
        """Where viscous friction stands."""
        return slice(self.coulomb.stop, self.coulomb.stop + self.joints)

    @property
    def dynamic(self) -> slice:
        """Where the dynamic parameters stand."""
        return slice(0, self.viscous.stop)

    @property
    def joint_pid(self) -> slice:
        """Where the gains stand."""
        return slice(self.viscous.stop, self.viscous.stop + len(JOINT_PID))

    def bodies_of(self, rigid: np.ndarray) -> np.ndarray:
        """Inertial parameters as one row (mass, Ixx, Iyy, Izz) a body; a view."""
        return rigid[..., self.rigid].reshape(*rigid.shape[:-1], len(self.bodies), len(INERTIAL))

    def leg_rows(self, leg: int) -> list[int]:
        """Where the inertial parameters of a leg's bodies stand, one body after the other."""
        return [len(INERTIAL) * body + entry for body in self.of_leg[leg] for entry in range(len(INERTIAL))]

    @property
    def joint_unit(self) -> str:
        """Unit of the joint coordinates."""
        return "m" if self.prismatic else "rad"

    def unit(self, name: str) -> str:
        """Unit of a parameter such as `crank1.mass` or `joint_pid.lp`; friction and gains follow the actuators."""
        return unit_of(name, self.prismatic)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """All parameters as those of rigid bodies, dry and viscous friction of the joints, and lp, li, ld (3,)."""
        return values[self.rigid], values[self.coulomb], values[self.viscous], values[self.joint_pid]

    def check(self, values: ArrayLike, *, batch: bool = False) -> np.ndarray:
        """Dynamic parameters as floats (p,), or (N, p) where a batch may be.

        Raises ParameterError for another shape, and for one that is NaN, infinite, negative, or no platform mass; it
        names the parameter with its value, unit and limit, and its row in a batch.
        """
        count = len(self.dynamic_names)
        shapes: list[Shape] = [(count,), ("N", count)]
        parameters = floats("parameters", values, *shapes[: 1 + batch], error=ParameterError, finite=False)
        allowed = (parameters >= 0) & (parameters < np.inf)
        allowed[..., 0] &= parameters[..., 0] > 0
        if allowed.all():
            return parameters
        place = tuple(int(index) for index in np.argwhere(~allowed)[0])
        name, limit = self.dynamic_names[place[-1]], ">= 0" if place[-1] else "> 0"
        where = f" (row {place[0]})" if len(place) > 1 else ""
        raise ParameterError(
            f"{name} = {parameters[place]:g} {self.unit(name)} is not allowed, must be finite and {limit}{where}"
        )


def parameter_layout(legs: Sequence[Leg]) -> ParameterLayout:
    """The layout of a robot with these legs: platform, then the first bodies of all legs, then the second ones."""
    found: list[tuple[int, Body]] = []
    for place in range(max(len(leg.bodies) for leg in legs)):
        found += [(number, leg.bodies[place]) for number, leg in enumerate(legs) if place < len(leg.bodies)]
    of_leg = [tuple(1 + k for k, (owner, _) in enumerate(found) if owner == number) for number in range(len(legs))]
    names = tuple(f"{body.name}{number + 1}" for number, body in found)
    kinds = tuple(body for _, body in found)
    return ParameterLayout(("platform", *names), (PLATFORM, *kinds), tuple(of_leg), legs[0].prismatic)


UNITS = {"mass": "kg", "Ixx": "kg m^2", "Iyy": "kg m^2", "Izz": "kg m^2"}
REVOLUTE = {"coulomb": "N m", "viscous": "N m s/rad", "lp": "N m/rad", "li": "N m/(rad s)", "ld": "N m s/rad"}
PRISMATIC = {"coulomb": "N", "viscous": "N s/m", "lp": "N/m", "li": "N/(m s)", "ld": "N s/m"}


def unit_of(name: str, prismatic: bool = False) -> str:
    """Unit of a parameter name such as `crank1.mass` or `joint_pid.lp`."""
    return (UNITS | (PRISMATIC if prismatic else REVOLUTE))[name.rsplit(".", 1)[1]]
