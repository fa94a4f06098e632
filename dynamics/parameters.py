"""Dynamic parameters of a robot: names, order, units and physical range (Xi of eq. 25).

The driven arm of a leg is called the crank. In the paper, it is called the wrench.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import Shape, floats
from dynamics.errors import ParameterError
from dynamics.legs.leg import Body, Leg
from dynamics.parameter_units import PASSIVE_JOINT, of_all_legs, unit_of
from dynamics.spatial_inertia import FIRST_MOMENTS, FULL_INERTIAL, INERTIAL, MOMENTS, PRODUCTS

PLATFORM = Body("platform", MOMENTS)
JOINT_PID = ("lp", "li", "ld")  # gains of the joint PID (eq. 31).
SIGNED = (*FIRST_MOMENTS, *PRODUCTS)  # inertial parameters that may be negative
ALL_TEN = list(range(len(FULL_INERTIAL)))  # indices of all parameters of a full body
# Indices of the parameters of a centred body among those of a full body.
CENTRED = [FULL_INERTIAL.index(name) for name in INERTIAL]
# Kinds of friction of a passive joint, each with one parameter.
PASSIVE_LAWS = ("coulomb", "viscous")
LANES = 8  # number of derivatives, or of runs, that are computed at once


def room_for_derivatives(rigid: int, joints: int, coordinates: int) -> int:
    """Number of columns for the derivatives of one quantity, rounded up to a multiple of LANES.

    There is one column for each parameter, for the length of a step, and for each entry of a start
    state. Each joint has columns for gains of its own, even if all joints share them, so that the
    compiled code is the same.
    """
    parameters = rigid + (2 + len(JOINT_PID)) * joints
    start = 3 * coordinates + joints
    return -(-(parameters + 1 + start) // LANES) * LANES


@dataclass(frozen=True, eq=False)
class RigidGroups:
    """Groups of inertial parameters. The motion depends on the parameters only through the groups.

    `combinations` (k, r) has the coefficients of the r parameters in each of the k groups. `pivots`
    (k,) are the indices of one parameter of each group, in ascending order. This parameter has the
    coefficient 1 in its group and 0 in all other groups.
    """

    pivots: np.ndarray
    combinations: np.ndarray

    def of_all(self, by_pivots: np.ndarray) -> np.ndarray:
        """Derivatives (..., p) with respect to all parameters.

        `by_pivots` has the derivatives with respect to the pivots, and then with respect to the
        parameters that are not inertial.
        """
        count = len(self.pivots)
        return np.concatenate(
            [by_pivots[..., :count] @ self.combinations, by_pivots[..., count:]], axis=-1
        )


@dataclass(frozen=True)
class ParameterLayout:
    """Layout of the parameters of a robot: of bodies, friction of all joints, and joint PID.

    `bodies` are the names of all bodies, the platform first, and `kinds` are their kinds. `of_leg`
    are the indices of the bodies of each leg. `prismatic` is True if the actuators slide. `full` is
    True for each body with ten inertial parameters, and False for each centred body, which has
    four. `own_gains` is True if each joint has its own gains, and False if all joints share them.
    `passive_names` are the parameters of the friction of passive joints: link_joint.viscous of all
    legs, or link3_joint.viscous of one.
    """

    bodies: tuple[str, ...]
    kinds: tuple[Body, ...]
    of_leg: tuple[tuple[int, ...], ...]
    prismatic: bool
    full: tuple[bool, ...]
    own_gains: bool = False
    passive_names: tuple[str, ...] = ()

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
        """Names of the inertial parameters, body by body, and of the friction of passive joints.

        These are the parameters of the equation of motion without friction of the actuators.
        """
        return self.inertial_names + self.passive_names

    @cached_property
    def inertial_names(self) -> tuple[str, ...]:
        """Names of the inertial parameters, body by body."""
        return tuple(
            f"{body}.{name}"
            for body, full in zip(self.bodies, self.full, strict=True)
            for name in (FULL_INERTIAL if full else INERTIAL)
        )

    @cached_property
    def signed(self) -> np.ndarray:
        """True for each dynamic parameter (p,) that may be negative because it is in SIGNED."""
        return np.isin([name.split(".")[1] for name in self.dynamic_names], SIGNED)

    @cached_property
    def coulomb_names(self) -> tuple[str, ...]:
        """Names of the dry friction parameters of the actuated joints."""
        return tuple(f"{joint}.coulomb" for joint in self.joint_names)

    @cached_property
    def viscous_names(self) -> tuple[str, ...]:
        """Names of the viscous friction parameters of the actuated joints."""
        return tuple(f"{joint}.viscous" for joint in self.joint_names)

    @cached_property
    def joint_pid_names(self) -> tuple[str, ...]:
        """Names of the gains of the joint PID: lp, li, ld for all joints, or joint by joint."""
        owners = self.joint_names if self.own_gains else ("joint_pid",)
        return tuple(f"{owner}.{gain}" for owner in owners for gain in JOINT_PID)

    @cached_property
    def dynamic_names(self) -> tuple[str, ...]:
        """Names of the dynamic parameters, in which the equation of motion is linear."""
        return self.rigid_names + self.coulomb_names + self.viscous_names

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters: the dynamic ones, then the gains."""
        return self.dynamic_names + self.joint_pid_names

    def derivatives(self, coordinates: int) -> int:
        """Number of columns for the derivatives of one quantity. See `room_for_derivatives`."""
        return room_for_derivatives(len(self.rigid_names), self.joints, coordinates)

    @property
    def rigid(self) -> slice:
        """Slice of the parameters with `rigid_names`."""
        return slice(0, len(self.rigid_names))

    @property
    def inertial(self) -> slice:
        """Slice of the inertial parameters."""
        return slice(0, len(self.inertial_names))

    @property
    def passive(self) -> slice:
        """Slice of the friction of passive joints."""
        return slice(self.inertial.stop, self.rigid.stop)

    @property
    def coulomb(self) -> slice:
        """Slice of the dry friction parameters of the actuated joints."""
        return slice(self.rigid.stop, self.rigid.stop + self.joints)

    @property
    def viscous(self) -> slice:
        """Slice of the viscous friction parameters of the actuated joints."""
        return slice(self.coulomb.stop, self.coulomb.stop + self.joints)

    @property
    def dynamic(self) -> slice:
        """Slice of the dynamic parameters."""
        return slice(0, self.viscous.stop)

    @property
    def joint_pid(self) -> slice:
        """Slice of the gains of the joint PID."""
        return slice(self.viscous.stop, self.viscous.stop + len(self.joint_pid_names))

    @property
    def full_bodies(self) -> tuple[str, ...]:
        """Names of the bodies with ten inertial parameters."""
        return tuple(body for body, full in zip(self.bodies, self.full, strict=True) if full)

    @cached_property
    def body_slices(self) -> tuple[slice, ...]:
        """Slice of the inertial parameters of each body."""
        counts = [len(FULL_INERTIAL) if full else len(INERTIAL) for full in self.full]
        ends = np.cumsum(counts).tolist()
        return tuple(slice(end - count, end) for end, count in zip(ends, counts, strict=True))

    def bodies_of(self, rigid: np.ndarray) -> np.ndarray:
        """Inertial parameters (..., bodies, 10) as of full bodies, zero where a body lacks one."""
        full_bodies = np.zeros((*rigid.shape[:-1], len(self.bodies), len(FULL_INERTIAL)))
        for body, rows in enumerate(self.body_slices):
            full_bodies[..., body, ALL_TEN if self.full[body] else CENTRED] = rigid[..., rows]
        return full_bodies

    def rigid_of(self, bodies: np.ndarray) -> np.ndarray:
        """Inertial parameters (..., r) of full bodies (..., bodies, 10).

        This is the inverse of `bodies_of`. The first moments and products of inertia of centred
        bodies are left out.
        """
        rows = [
            bodies[..., body, ALL_TEN if full else CENTRED] for body, full in enumerate(self.full)
        ]
        return np.concatenate(rows, axis=-1)

    def converted(self, dynamic: np.ndarray, other: "ParameterLayout") -> np.ndarray:
        """Dynamic parameters (..., p) in another layout of the same robot.

        Parameters that this layout does not have are zero. If friction of passive joints becomes
        shared, it is the mean over the legs.
        """
        inertial = other.rigid_of(self.bodies_of(dynamic))
        passive = np.zeros((*dynamic.shape[:-1], len(other.passive_names)))
        for index, name in enumerate(other.passive_names):
            for own_name in self.passive_names:
                value = dynamic[..., self.dynamic_names.index(own_name)]
                if own_name in (name, of_all_legs(name)):
                    passive[..., index] = value
                elif of_all_legs(own_name) == name:
                    passive[..., index] += value / self.joints
        rest = dynamic[..., self.rigid.stop : self.dynamic.stop]
        return np.concatenate([inertial, passive, rest], axis=-1)

    def each_gains(self, gains: np.ndarray) -> np.ndarray:
        """Gains lp, li, ld of each joint (..., n, 3), from the gains (..., 3) or (..., 3 n)."""
        rows = gains.reshape(*gains.shape[:-1], -1, len(JOINT_PID))
        return np.broadcast_to(rows, (*gains.shape[:-1], self.joints, len(JOINT_PID)))

    def converted_gains(self, gains: np.ndarray, other: "ParameterLayout") -> np.ndarray:
        """Gains in another layout of the same robot, shared by all joints or joint by joint.

        Gains that become shared are the mean of those of all joints.
        """
        if self.own_gains == other.own_gains:
            return gains
        each = self.each_gains(gains)
        if other.own_gains:
            return each.reshape(-1)
        # the mean of equal numbers can differ from them in the last digit
        return np.where((each == each[0]).all(axis=0), each[0], each.mean(axis=0))

    def leg_slices(self, leg: int) -> list[slice]:
        """Slice of the inertial parameters of each body of a leg."""
        return [self.body_slices[body] for body in self.of_leg[leg]]

    @property
    def joint_unit(self) -> str:
        """Unit of the joint coordinates."""
        return "m" if self.prismatic else "rad"

    def unit(self, name: str) -> str:
        """Unit of a parameter, such as `crank1.mass` or `joint_pid.lp`.

        The units of friction and gains depend on the kind of actuators.
        """
        return unit_of(name, self.prismatic)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rigid parameters, dry and viscous friction (n,) of the actuated joints, and gains (n, 3).

        The rigid parameters are those with `rigid_names`. The gains are lp, li, ld of each joint.
        """
        return (
            values[self.rigid],
            values[self.coulomb],
            values[self.viscous],
            self.each_gains(values[self.joint_pid]),
        )

    def without_gains(self, values: ArrayLike) -> ArrayLike:
        """Dynamic parameters (..., p) of an array of all parameters. Other arrays are unchanged."""
        if isinstance(values, np.ndarray) and values.shape[-1:] == (len(self.names),):
            return np.asarray(values[..., self.dynamic])
        return values

    def check(self, values: ArrayLike, *, batch: bool = False) -> np.ndarray:
        """Dynamic parameters as floats (p,), or (N, p) if `batch` is True.

        Raises ParameterError for a wrong shape, for a value that is NaN, infinite or negative, and
        for a platform without mass. First moments and products of inertia may be negative. The
        message has the parameter with its value, unit and limit, and its row in a batch.
        """
        count = len(self.dynamic_names)
        shapes: list[Shape] = [(count,), ("N", count)]
        parameters = floats(
            "parameters", values, *shapes[: 1 + batch], error=ParameterError, finite=False
        )
        allowed = (self.signed | (parameters >= 0)) & (np.abs(parameters) < np.inf)
        allowed[..., 0] &= parameters[..., 0] > 0
        if allowed.all():
            return parameters
        entry = tuple(int(index) for index in np.argwhere(~allowed)[0])
        name = self.dynamic_names[entry[-1]]
        limit = " and > 0" if not entry[-1] else "" if self.signed[entry[-1]] else " and >= 0"
        where = f" (row {entry[0]})" if len(entry) > 1 else ""
        raise ParameterError(
            f"{name} = {parameters[entry]:g} {self.unit(name)} is not allowed, must be finite"
            f"{limit}{where}"
        )


def may_be_absent(name: str) -> bool:
    """Return True for a parameter that a layout can lack. Its value is then zero.

    These are first moments and products of inertia, and the friction of passive joints.
    """
    joint, _, entry = name.rpartition(".")
    return entry in SIGNED or joint.endswith(PASSIVE_JOINT.format(""))


def passive_parameters(legs: Sequence[Leg]) -> tuple[str, ...]:
    """Names of the friction parameters of passive joints that all legs can share."""
    bodies = [
        body.name
        for leg in legs
        for body, segment in zip(leg.bodies, leg.segments(), strict=True)
        if segment.passive
    ]
    joints = [PASSIVE_JOINT.format(name) for name in dict.fromkeys([*bodies, "platform"])]
    return tuple(f"{joint}.{law}" for joint in joints for law in PASSIVE_LAWS)


def own_passive_parameters(legs: Sequence[Leg]) -> tuple[str, ...]:
    """Names of the friction parameters that passive joints of single legs can have instead."""
    return tuple(
        name.replace("_joint.", f"{number}_joint.")
        for number, leg in enumerate(legs, start=1)
        for name in passive_parameters([leg])
    )


def parameter_layout(
    legs: Sequence[Leg],
    full: Sequence[str] = (),
    own_gains: bool = False,
    passive: Sequence[str] = (),
) -> ParameterLayout:
    """Layout of the parameters of a robot with given legs.

    The platform is first. The first bodies of all legs follow, and then their second bodies. `full`
    are the names of the bodies or kinds of bodies with ten inertial parameters, such as link2 or
    link, or "all". `own_gains` is True if each joint has its own gains. `passive` are the names of
    parameters of passive joints (see `passive_parameters` and `own_passive_parameters`).

    Raises ParameterError for an unknown name, and for a passive joint with both its own parameter
    and that of all legs.
    """
    leg_bodies: list[tuple[int, Body]] = []
    for index in range(max(len(leg.bodies) for leg in legs)):
        leg_bodies += [
            (number, leg.bodies[index])
            for number, leg in enumerate(legs)
            if index < len(leg.bodies)
        ]
    of_leg = [
        tuple(1 + k for k, (owner, _) in enumerate(leg_bodies) if owner == number)
        for number in range(len(legs))
    ]
    names = ("platform", *(f"{body.name}{number + 1}" for number, body in leg_bodies))
    kinds = (PLATFORM, *(body for _, body in leg_bodies))
    valid = {"all", *names, *(kind.name for kind in kinds)}
    if unknown := [name for name in full if name not in valid]:
        raise ParameterError(
            f"there is no body {unknown[0]!r}; valid: all, "
            f"{', '.join(dict.fromkeys(kind.name for kind in kinds))}, or a body such as "
            f"{names[-1]}"
        )
    shared = passive_parameters(legs) if passive else ()
    possible = (*shared, *own_passive_parameters(legs)) if passive else ()
    if unknown := [name for name in passive if name not in possible]:
        raise ParameterError(
            f"there is no friction {unknown[0]!r} of passive joints; valid: {', '.join(shared)}, "
            f"or of one leg, such as {possible[len(shared)]}"
        )
    if both := [name for name in passive if of_all_legs(name) in {*passive} - {name}]:
        raise ParameterError(
            f"{both[0]} and {of_all_legs(both[0])} are friction of one joint: state one of them"
        )
    return ParameterLayout(
        names,
        kinds,
        tuple(of_leg),
        legs[0].prismatic,
        tuple(
            bool({"all", name, kind.name} & set(full))
            for name, kind in zip(names, kinds, strict=True)
        ),
        own_gains,
        tuple(name for name in possible if name in passive),
    )
