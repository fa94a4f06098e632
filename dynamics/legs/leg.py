"""Leg of any kind in CasADi, as a function of the motion of its platform joint A.

The motion of A determines the motion of the bodies of a leg (eq. 5-16). Each leg therefore adds a
force F at A. The wrench on the robot is the wrench of the platform itself plus the sum of [F; a x
F] over the legs, with the vector a from the platform's origin to A. This is the virtual-work model
of eq. 23, with Jacobians with respect to the velocity of A (3 columns) instead of the twist (6
columns). This form needs a fraction of the operations.

A kind of leg defines the positions and rotations of its bodies; their forces follow by virtual
work. A kind can also define closed forms that are faster. The inverse kinematics of a kind is the
method `coordinate`, in `crank_legs`, `pss` or `ups`. The motion of A and the forces at A, vectors
(3,), are in the axes of the base. Units are SI. The actuated coordinate is in rad for a rotating
actuator, and in m for a sliding one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, WithJsonSchema

from dynamics.checks import Length as Length
from dynamics.checks import Place, shown, within
from dynamics.errors import RobotFileError
from dynamics.expressions import symmetric_from_lower
from dynamics.spatial_inertia import SpatialInertia, spatial_inertia


def _vector(value: object) -> np.ndarray:
    """Read-only array of three numbers in the range of `Place`. Raises ValueError for others."""
    array = np.array(value)
    if array.shape != (3,) or array.dtype.kind not in "fi" or not np.isfinite(array).all():
        raise ValueError(f"needs 3 finite numbers, got {shown(value)}")
    array = array.astype(float)
    farthest = float(array[np.argmax(np.abs(array))])
    within(Place).check(farthest)
    array.setflags(write=False)
    return array


# Largest error of the length of a direction, or of a right angle, in a file. Directions can thus be
# written with four decimals or more.
ROUNDED = 1e-4
# Largest error of a length or of a right angle that counts as rounding and is not corrected.
EXACT = 1e-12


def _direction(value: object) -> np.ndarray:
    """Vector (3,) scaled to the length 1. Raises ValueError if its length is far from 1."""
    array = _vector(value)
    length = float(np.linalg.norm(array))
    if abs(length - 1.0) > ROUNDED:
        raise ValueError(f"has length {length:.9g}, must be 1")
    return array if abs(length - 1.0) < EXACT else _vector(array / length)


# Largest rotation of a body per motion of A, rad/m. No real machine exceeds it. In a singular pose,
# rounding gives about 1e15 instead of infinity.
MOST_TURNING = 1e6

_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
Point = Annotated[np.ndarray, PlainValidator(_vector), WithJsonSchema(_NUMBERS)]
Direction = Annotated[np.ndarray, PlainValidator(_direction), WithJsonSchema(_NUMBERS)]


@dataclass(frozen=True)
class Body:
    """Body of a kind of leg, such as the crank.

    `moments` are the moments of inertia that do work when the body moves. `driven` is the inertial
    parameter that includes the inertia of the motor, if an actuator drives this body alone, or
    None.
    """

    name: str
    moments: tuple[str, ...]
    driven: str | None = None


class Placement(NamedTuple):
    """Placement of a body: its reference point `centre` (3,), m, and its axes (3, 3) as columns.

    The inertial parameters are about this point and in these axes. The reference point of a centred
    body is its centre of mass.
    """

    centre: ca.SX
    axes: ca.SX


class Segment(NamedTuple):
    """Body in the chain from the base to A, for other physics engines and for drawing.

    `joint` connects it with the body before it, or with the base. It is "hinge" about `axis`,
    "slide" along `axis`, "universal" about `axis` and then about x of this body, or "ball". `axis`
    (3,) is in the axes of the body before. `origin` (3,) is the vector, m, from the joint of the
    body before to this joint, in the same axes. For a slide, it is the vector at coordinate zero.

    The frame of the body is at its joint, with the axes of its `Placement`. Three positions are in
    this frame, m: `centre` (3,) is the reference point, `rod` (2, 3) are the ends of the drawn rod,
    which has the radius `radius`, and `end` (3,) is A on the last body.

    `actuated` is True if the coordinate of this joint is the coordinate of the leg. `copies` are
    the offsets (bars, 3) of the joints of several equal bars from `origin`, in the same axes. The
    bars share the parameters of the body. On the last body, the ends of the bars have the same
    offsets from A.
    """

    joint: str
    axis: np.ndarray
    origin: np.ndarray
    centre: np.ndarray
    rod: np.ndarray
    radius: float
    end: np.ndarray | None = None
    actuated: bool = False
    copies: np.ndarray = np.zeros((1, 3))

    @property
    def passive(self) -> bool:
        """True if the joint turns without an actuator."""
        return self.joint != "slide" and not self.actuated


class Leg(BaseModel, ABC):
    """Leg with a base joint B and a platform joint A.

    B (3,) is in the axes of the base, and A (3,) in the axes of the platform, m. `branch`, +1 or
    -1, selects one of two solutions of the inverse kinematics. The default is the solution whose
    coordinate at home is nearest to zero. Raises pydantic's ValidationError for invalid numbers.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bodies: ClassVar[tuple[Body, ...]]
    prismatic: ClassVar[bool]
    chart: ClassVar[str] = "free"
    """Chart that a platform must have for this kind of leg."""
    numbers: ClassVar[tuple[str, ...]]
    """Names of the geometric numbers of the leg. See `legs.geometric_numbers`."""
    turned: ClassVar[tuple[str, ...]] = ()
    """Fields that rotations change: an axis, and the zero direction perpendicular to it, if any."""

    base_joint: Point = Field(description="joint B on the base; base axes, m")
    platform_joint: Point = Field(description="joint A on the platform; platform axes, m")
    branch: Literal[-1, 1] | None = Field(
        None,
        description="+1 or -1: solution of the inverse kinematics; default: the one with the "
        "coordinate nearest to zero at home",
    )

    @property
    def travel_room(self) -> float:
        """Distance, m, of coordinate zero from the nearer end of the stroke, or infinity."""
        return float("inf")

    @property
    def side(self) -> float | ca.SX:
        """Selected branch of the inverse kinematics, or +1 if no branch is selected."""
        return 1.0 if self.branch is None else self.branch

    def assembled(self, joint: np.ndarray, number: int) -> Self:
        """Leg whose branch is selected for the position (3,) of A at home.

        Raises RobotFileError, with the number of the leg, if the leg cannot reach A. Raises it also
        if a body is parallel to the axis from which its rotation is measured, such as the axis of a
        universal joint.
        """
        margin = float(self.reach(ca.SX(joint)))
        if not margin > 0:
            raise RobotFileError(
                f"leg {number} cannot reach the home pose: reach margin {margin:.3g}, must be > 0; "
                f"B to A {np.linalg.norm(joint - self.base_joint):.4g} m, {self.lengths()}"
            )
        assembled = self
        if self.branch is None:
            both = [self.model_copy(update={"branch": sign}) for sign in (1, -1)]
            assembled = min(both, key=lambda leg: abs(float(leg.coordinate(ca.SX(joint)))))
        for body, turning in zip(assembled.bodies, assembled._turning(joint), strict=True):
            if not turning < MOST_TURNING:
                raise RobotFileError(
                    f"leg {number} is singular at the home pose: its {body.name} turns by "
                    f"{turning:.3g} rad/m, limit {MOST_TURNING:.0e}; it lies along the axis of its "
                    "universal joint or of its actuator"
                )
        return assembled

    def _turning(self, joint: np.ndarray) -> np.ndarray:
        """Rotation of each body per motion of A, rad/m, or NaN if the axes are undefined."""
        point = ca.SX.sym("position", 3)
        point_rate = ca.SX.sym("velocity", 3)
        turns = [
            ca.norm_fro(ca.jacobian(spin, point_rate))
            for spin in self.angular_velocities(point, point_rate)
        ]
        axes = [ca.sum1(ca.vec(placement.axes)) for placement in self.placements(point)]
        turning, axis_sums = ca.Function(
            "turning", [point], [ca.vertcat(*turns), ca.vertcat(*axes)]
        )(joint)
        # undefined axes are NaN, and make the sum NaN
        return np.array(turning).ravel() + 0 * np.array(axis_sums).ravel()

    @abstractmethod
    def lengths(self) -> str:
        """Text with the lengths of the leg, for messages."""

    def zeroed(self, joint: np.ndarray) -> Self:
        """Leg whose coordinate is zero if A is at `joint` (3,)."""
        return self.shifted(float(self.coordinate(ca.SX(joint))))

    @abstractmethod
    def shifted(self, by: float) -> Self:
        """Leg whose coordinate at each position of A is smaller by `by`, rad or m."""

    @abstractmethod
    def coordinate(self, position: ca.SX) -> ca.SX:
        """Actuated coordinate. It is NaN out of reach."""

    @abstractmethod
    def reach(self, position: ca.SX) -> ca.SX:
        """Reach margin, without unit, at most 1. It is zero or negative out of reach."""

    @abstractmethod
    def gap(self, position: ca.SX, coordinate: ca.SX) -> ca.SX:
        """Gap of the leg's loop, m^2: half the error of a squared length, for any coordinate.

        It is a smooth function of the position, even out of reach.
        """

    @abstractmethod
    def direction(self, position: ca.SX) -> ca.SX:
        """Unit vector (3,) along the force at A that is due to the actuator."""

    @abstractmethod
    def leverage(self, position: ca.SX) -> ca.SX:
        """Leverage of the actuator on its leg, in 0..1.

        It is zero if the leg is singular, because its entry of J_a1 (eq. 7) is then zero.
        """

    @abstractmethod
    def placements(self, position: ca.SX) -> list[Placement]:
        """Placements of the leg's bodies."""

    @abstractmethod
    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        """Angular velocities (3,) of the bodies, linear in the velocity (3,) of A."""

    def driven_inertia(self, body: np.ndarray) -> float:
        """Inertia of the driven body at its actuator, kg or kg m^2, or NaN if there is none.

        `body` (10,) has the inertial parameters of a full body.
        """
        return float(body[0]) if self.bodies[0].driven == "mass" else np.nan

    @abstractmethod
    def segments(self) -> list[Segment]:
        """Bodies as a chain from the base."""

    def gradient(self, position: ca.SX) -> ca.SX:
        """Gradient (3,) of the coordinate with respect to A.

        It is also the force at A due to a unit torque or force of the actuator (eq. 8).
        """
        point = ca.SX.sym("position", 3)
        return ca.substitute(ca.jacobian(self.coordinate(point), point).T, point, position)

    def line(self, position: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Vector (3,) and divisor (terms of eq. 7) whose ratio is the gradient (eq. 8)."""
        return self.gradient(position), ca.SX(1)

    def acceleration(self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        """Second time derivative of the coordinate."""
        point = ca.SX.sym("position", 3)
        point_rate = ca.SX.sym("velocity", 3)
        bias = ca.jtimes(ca.dot(self.gradient(point), point_rate), point, point_rate)
        bias = ca.substitute(bias, ca.vertcat(point, point_rate), ca.vertcat(position, velocity))
        return ca.dot(self.gradient(position), acceleration) + bias

    def force(
        self,
        position: ca.SX,
        velocity: ca.SX,
        acceleration: ca.SX,
        parameters: Sequence[ca.SX],
        gravity: ca.DM,
    ) -> ca.SX:
        """Force at A (3,), N, that is needed for the motion of bodies with inertial parameters.

        `parameters` has those of each body: 4 if the body is centred, 10 if it is full.
        """
        # symbols, with respect to which the maps can be differentiated
        point, point_rate, point_acceleration = (ca.SX.sym(name, 3) for name in "pva")
        symbols = _symbols_for(parameters)
        total = ca.SX.zeros(3)
        for inertia, centre_map, spin_map, spin in self._maps(point, point_rate, symbols):
            centre_acceleration = centre_map @ point_acceleration + ca.jtimes(
                centre_map @ point_rate, point, point_rate
            )
            spin_acceleration = spin_map @ point_acceleration + ca.jtimes(spin, point, point_rate)
            push, moment = inertia.load(centre_acceleration - gravity, spin, spin_acceleration)
            total += centre_map.T @ push
            total += spin_map.T @ moment
        return _replaced(
            total,
            (point, point_rate, point_acceleration, *symbols),
            (position, velocity, acceleration, *parameters),
        )

    def mass(self, position: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
        """Mass matrix (3, 3) of the leg at A. For `parameters` see `force`."""
        point = ca.SX.sym("p", 3)
        point_rate = ca.SX.sym("v", 3)
        symbols = _symbols_for(parameters)
        total = ca.SX.zeros(3, 3)
        for inertia, centre_map, spin_map, _ in self._maps(point, point_rate, symbols):
            total += inertia.mass_matrix(centre_map, spin_map)
        return symmetric_from_lower(_replaced(total, (point, *symbols), (position, *parameters)))

    def coriolis(self, position: ca.SX, velocity: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
        """Matrix C (3, 3). C times the velocity is the Coriolis and centrifugal force at A.

        It is the sum of J^T (M_body J_dot + C_body J) over the bodies (eq. 21, 22).
        """
        point = ca.SX.sym("p", 3)
        point_rate = ca.SX.sym("v", 3)
        symbols = _symbols_for(parameters)
        total = ca.SX.zeros(3, 3)
        for inertia, centre_map, spin_map, spin in self._maps(point, point_rate, symbols):
            map_rates = [
                ca.reshape(ca.jtimes(ca.vec(ca.densify(m)), point, point_rate), 3, 3)
                for m in (centre_map, spin_map)
            ]
            maps = (centre_map, spin_map)
            for part in inertia.coriolis_parts(maps, map_rates, centre_map @ point_rate, spin):
                total += part
        return _replaced(total, (point, point_rate, *symbols), (position, velocity, *parameters))

    def _maps(
        self, position: ca.SX, velocity: ca.SX, parameters: Sequence[ca.SX]
    ) -> list[tuple[SpatialInertia, ca.SX, ca.SX, ca.SX]]:
        """Inertia, two maps and angular velocity of every body, for a motion of A as symbols.

        The maps (3, 3) give the velocity of the reference point and the angular velocity from the
        velocity of A.
        """
        maps_of_bodies = []
        spins = self.angular_velocities(position, velocity)
        for body, of_body, placement, spin in zip(
            self.bodies, parameters, self.placements(position), spins, strict=True
        ):
            maps = ca.jacobian(placement.centre, position), ca.jacobian(spin, velocity)
            maps_of_bodies.append(
                (spatial_inertia(of_body, placement.axes, body.moments), *maps, spin)
            )
        return maps_of_bodies


def _symbols_for(parameters: Sequence[ca.SX]) -> list[ca.SX]:
    """Symbols for the inertial parameters of bodies."""
    return [ca.SX.sym(f"i{k}", of_body.numel()) for k, of_body in enumerate(parameters)]


def _replaced(expression: ca.SX, symbols: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.SX:
    """Expression with values in place of symbols."""
    return ca.substitute(ca.cse(expression), ca.vertcat(*symbols), ca.densify(ca.vertcat(*values)))


def link_axes(across_from: np.ndarray | ca.SX, z: ca.SX) -> ca.SX:
    """Axes (3, 3) of a link along the unit vector z.

    x is along the cross product of the direction `across_from` and z, and y along that of z and x.
    """
    across = ca.cross(ca.SX(across_from), z)
    x = across * (1 / ca.norm_2(across))
    return ca.horzcat(x, ca.cross(z, x), z)


def universal_spin(axis: np.ndarray | ca.SX, z: ca.SX, z_rate: ca.SX) -> ca.SX:
    """Angular velocity (3,) of a body on a universal joint whose axis z (3,) has the rate `z_rate`.

    The body turns about a first axis, a unit vector fixed on the base, and about its own x (see
    `link_axes`).
    """
    across = ca.cross(ca.SX(axis), z)
    inverse = 1 / ca.dot(across, across)
    # rotation about the first axis moves z along `across`; rotation about x moves it along y
    turn = ca.dot(z_rate, across) * inverse
    swing = ca.dot(z_rate, ca.cross(z, across)) * inverse
    return turn * axis - swing * across
