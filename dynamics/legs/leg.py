"""Leg of any kind in CasADi, as a function of the motion of its platform joint A alone.

The bodies of a leg move as A makes them move (eq. 5-16). Each leg therefore adds a force F at A,
and the wrench of the robot is the sum of the platform's own wrench and [F; a x F] over the legs.
This is the virtual-work model of eq. 23, with Jacobians with respect to the velocity of A (3
columns) and not to the twist (6 columns), at a fraction of the operations.

A kind of leg says where its bodies are and how they turn, and their forces follow by virtual work.
A kind whose closed form is faster may give that. Vectors are in the axes of the base, and A is a
position (3,) in them. Units are SI, and the actuated coordinate is rad where the actuator turns and
m where it slides.
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

INERTIAL = ("mass", "Ixx", "Iyy", "Izz")
"""Inertial parameters of a body: kg, and kg m^2 about its own axes through its centre of mass."""


def _vector(value: object) -> np.ndarray:
    """Three finite numbers. Raises ValueError."""
    array = np.array(value)
    if array.shape != (3,) or array.dtype.kind not in "fi" or not np.isfinite(array).all():
        raise ValueError(f"needs 3 finite numbers, got {shown(value)}")
    array = array.astype(float)
    farthest = float(array[np.argmax(np.abs(array))])
    within(Place).check(farthest)
    array.setflags(write=False)
    return array


ROUNDED = 1e-4
"""Largest error of the length of a direction, or of a right angle.

Directions may be written with four decimals or more.
"""
EXACT = 1e-12
"""Errors below this are not corrected."""


def _direction(value: object) -> np.ndarray:
    """Unit vector of three numbers. Raises ValueError."""
    array = _vector(value)
    length = float(np.linalg.norm(array))
    if abs(length - 1.0) > ROUNDED:
        raise ValueError(f"has length {length:.9g}, must be 1")
    return array if abs(length - 1.0) < EXACT else _vector(array / length)


MOST_TURNING = 1e6
"""Largest turning of a body, rad/m.

No machine turns more. Rounding gives 1e15 where the limit is infinite.
"""

_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
Point = Annotated[np.ndarray, PlainValidator(_vector), WithJsonSchema(_NUMBERS)]
Direction = Annotated[np.ndarray, PlainValidator(_direction), WithJsonSchema(_NUMBERS)]


@dataclass(frozen=True)
class Body:
    """Kind of a body of a leg.

    `moments` are those that do work as it moves. `driven` is the inertial parameter of a body that
    an actuator moves alone, in which the motor has a share, or None.
    """

    name: str
    moments: tuple[str, ...]
    driven: str | None = None


class Placement(NamedTuple):
    """Place of a body: centre of mass (3,), and axes (3, 3) as columns, in which its moments
    are.
    """

    centre: ca.SX
    axes: ca.SX


class Segment(NamedTuple):
    """Body in the chain from the base to A, as other engines build it and as it is drawn.

    `joint` leads to the body before, or to the base: "hinge" about `axis`, "slide" along it,
    "universal" about `axis` and then about x of this body, or "ball". `axis` (3,) is in the axes of
    the body before, and `origin` (3,) leads there from the joint of the body before to this joint.
    The frame of the body is at its joint, with the axes of its `Placement`. In that frame are
    `centre` (3,), the centre of mass; `rod` (2, 3), the ends of what is drawn, m, with a radius;
    and `end`, which is A for the last body. `actuated` is True where the coordinate of the leg is
    that of this joint. `copies` are offsets (bars, 3) of the joints of several equal bars from
    `origin`, in the same axes. The bars share the parameters of the body, and in the last body each
    of them ends as far from A.
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


class Leg(BaseModel, ABC):
    """Leg with a base joint B, where it starts, and a platform joint A in platform axes, (3,) each,
    m.

    `branch`, +1 or -1, names one of two solutions of its inverse kinematics. The default is the one
    whose coordinate at home is nearest to zero. Raises pydantic's ValidationError for numbers that
    make no leg.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bodies: ClassVar[tuple[Body, ...]]
    prismatic: ClassVar[bool]
    chart: ClassVar[str] = "free"
    """What the platform's freedoms have to be for this leg to work."""
    numbers: ClassVar[tuple[str, ...]]
    """What decides where the leg lets A be: entries of its joints, lengths, turns; see
    `legs.geometric_numbers`.
    """
    turned: ClassVar[tuple[str, ...]] = ()
    """The fields that turns change: an axis, and a direction across it where the coordinate is
    zero.
    """

    base_joint: Point = Field(description="B, where the leg starts on the base; base axes, m")
    platform_joint: Point = Field(description="A, where it ends on the platform; platform axes, m")
    branch: Literal[-1, 1] | None = Field(
        None,
        description="+1 or -1: which solution of the inverse kinematics; default: nearest to zero "
        "at home",
    )

    @property
    def side(self) -> float | ca.SX:
        """Sign of the root that the branch takes, +1 or -1. It is +1 while no branch is chosen."""
        return 1.0 if self.branch is None else self.branch

    def assembled(self, joint: np.ndarray, number: int) -> Self:
        """Leg with its branch chosen for the position (3,) of A at home.

        Raises RobotFileError, with the number of the leg, reach and lengths, where the leg cannot
        reach. Raises it also for a body that lies along an axis from which its turning is counted,
        such as one of a universal joint.
        """
        margin = float(self.reach(ca.SX(joint)))
        if not margin > 0:
            raise RobotFileError(
                f"leg {number} cannot reach the home pose: reach margin {margin:.3g}, must be > 0; "
                f"B to A {np.linalg.norm(joint - self.base_joint):.4g} m, {self.lengths()}"
            )
        found = self
        if self.branch is None:
            both = [self.model_copy(update={"branch": sign}) for sign in (1, -1)]
            found = min(both, key=lambda leg: abs(float(leg.coordinate(ca.SX(joint)))))
        for body, turning in zip(found.bodies, found._turning(joint), strict=True):
            if not turning < MOST_TURNING:
                raise RobotFileError(
                    f"leg {number} is singular at the home pose: its {body.name} turns by "
                    f"{turning:.3g} rad/m, limit {MOST_TURNING:.0e}; it lies along the axis of its "
                    "universal joint or of its actuator"
                )
        return found

    def _turning(self, joint: np.ndarray) -> np.ndarray:
        """Turning of each body as A moves, rad/m. NaN for bodies whose axes are not known."""
        at = ca.SX.sym("position", 3)
        moving = ca.SX.sym("velocity", 3)
        turns = [
            ca.norm_fro(ca.jacobian(spin, moving)) for spin in self.angular_velocities(at, moving)
        ]
        axes = [ca.sum1(ca.vec(place.axes)) for place in self.placements(at)]
        turning, known = ca.Function("turning", [at], [ca.vertcat(*turns), ca.vertcat(*axes)])(
            joint
        )
        return np.array(turning).ravel() + 0 * np.array(known).ravel()

    @abstractmethod
    def lengths(self) -> str:
        """Lengths of the leg, for messages."""

    def zeroed(self, joint: np.ndarray) -> Self:
        """Leg whose coordinate is zero where A is at `joint` (3,)."""
        return self.shifted(float(self.coordinate(ca.SX(joint))))

    @abstractmethod
    def shifted(self, by: float) -> Self:
        """Leg whose coordinate reads less by a value, rad or m."""

    @abstractmethod
    def coordinate(self, position: ca.SX) -> ca.SX:
        """Actuated coordinate, NaN out of reach."""

    @abstractmethod
    def reach(self, position: ca.SX) -> ca.SX:
        """Reach margin, without unit and at most 1. It is zero or negative out of reach."""

    @abstractmethod
    def gap(self, position: ca.SX, coordinate: ca.SX) -> ca.SX:
        """Gap of the loop, m^2, for any coordinate. It is smooth wherever A is."""

    @abstractmethod
    def direction(self, position: ca.SX) -> ca.SX:
        """Unit vector (3,) of the force at A that the actuator can give."""

    @abstractmethod
    def leverage(self, position: ca.SX) -> ca.SX:
        """Leverage of the actuator on its leg, in 0..1. It is zero where the leg is singular
        (J_a1).
        """

    @abstractmethod
    def placements(self, position: ca.SX) -> list[Placement]:
        """Places of the leg's bodies."""

    @abstractmethod
    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        """Angular velocities (3,) of the bodies, linear in the velocity (3,) of A."""

    def driven_inertia(self, body: np.ndarray) -> float:
        """Inertia of the driven body, given as mass, Ixx, Iyy, Izz (4,), at its actuator.

        NaN where no body is driven.
        """
        return float(body[0]) if self.bodies[0].driven == "mass" else float("nan")

    @abstractmethod
    def segments(self) -> list[Segment]:
        """Bodies as a chain from the base."""

    def gradient(self, position: ca.SX) -> ca.SX:
        """Gradient (3,) of the coordinate with respect to A.

        It is the force at A of a unit torque or force (eq. 8).
        """
        at = ca.SX.sym("position", 3)
        return ca.substitute(ca.jacobian(self.coordinate(at), at).T, at, position)

    def line(self, position: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Vector (3,) along the gradient, and its divisor: eq. 7 before it becomes eq. 8."""
        return self.gradient(position), ca.SX(1)

    def acceleration(self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        """Second time derivative of the coordinate."""
        at = ca.SX.sym("position", 3)
        moving = ca.SX.sym("velocity", 3)
        bend = ca.jtimes(ca.dot(self.gradient(at), moving), at, moving)
        bend = ca.substitute(bend, ca.vertcat(at, moving), ca.vertcat(position, velocity))
        return ca.dot(self.gradient(position), acceleration) + bend

    def force(
        self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX, rigid: ca.SX, gravity: ca.DM
    ) -> ca.SX:
        """Force at A (3,), N, that moves the bodies.

        `rigid` (4 n,) are the inertial parameters of the bodies, one after the other.
        """
        at, moving, gaining, own = (
            ca.SX.sym(name, n) for name, n in zip("pvai", (3, 3, 3, rigid.numel()), strict=True)
        )
        total = ca.SX.zeros(3)
        for body, centre_map, spin_map, spin in self._maps(at, moving, own):
            centre_rate = centre_map @ moving
            mass = body[0]
            inertia = body[1]
            centre_gain = centre_map @ gaining + ca.jtimes(centre_rate, at, moving)
            spin_gain = spin_map @ gaining + ca.jtimes(spin, at, moving)
            total += centre_map.T @ (mass * (centre_gain - gravity))
            total += spin_map.T @ (inertia @ spin_gain + ca.cross(spin, inertia @ spin))
        return _replaced(
            total, (at, moving, gaining, own), (position, velocity, acceleration, rigid)
        )

    def mass(self, position: ca.SX, rigid: ca.SX) -> ca.SX:
        """Mass (3, 3) that the leg adds at A."""
        at = ca.SX.sym("p", 3)
        moving = ca.SX.sym("v", 3)
        own = ca.SX.sym("i", rigid.numel())
        total = ca.SX.zeros(3, 3)
        for (mass, inertia), centre_map, spin_map, _ in self._maps(at, moving, own):
            total += mass * (centre_map.T @ centre_map) + spin_map.T @ inertia @ spin_map
        return symmetric_from_lower(_replaced(total, (at, own), (position, rigid)))

    def coriolis(self, position: ca.SX, velocity: ca.SX, rigid: ca.SX) -> ca.SX:
        """Matrix C (3, 3), of which C velocity is the Coriolis and centrifugal force at A.

        It is that of eq. 21 and 22: the sum of J^T (M_body J_dot + C_body J).
        """
        at = ca.SX.sym("p", 3)
        moving = ca.SX.sym("v", 3)
        own = ca.SX.sym("i", rigid.numel())
        total = ca.SX.zeros(3, 3)
        for (mass, inertia), centre_map, spin_map, spin in self._maps(at, moving, own):
            centre_gain, spin_gain = (
                ca.reshape(ca.jtimes(ca.vec(ca.densify(m)), at, moving), 3, 3)
                for m in (centre_map, spin_map)
            )
            total += mass * (centre_map.T @ centre_gain)
            total += spin_map.T @ (inertia @ spin_gain + ca.skew(spin) @ inertia @ spin_map)
        return _replaced(total, (at, moving, own), (position, velocity, rigid))

    def _maps(
        self, position: ca.SX, velocity: ca.SX, rigid: ca.SX
    ) -> list[tuple[tuple[ca.SX, ca.SX], ca.SX, ca.SX, ca.SX]]:
        """Mass, inertia (3, 3), maps and angular velocity of every body.

        The maps (3, 3) are from the velocity of A to that of the centre, and to the angular
        velocity.
        """
        found = []
        spins = self.angular_velocities(position, velocity)
        for body, (place, spin) in enumerate(zip(self.placements(position), spins, strict=True)):
            own = rigid[4 * body : 4 * body + 4]
            # moments that do no work would leave rounding errors
            working = [
                own[k] if name in self.bodies[body].moments else 0
                for k, name in enumerate(INERTIAL)
            ]
            inertia = place.axes @ ca.diag(ca.vertcat(*working[1:])) @ place.axes.T
            maps = ca.jacobian(place.centre, position), ca.jacobian(spin, velocity)
            found.append(((own[0], inertia), *maps, spin))
        return found


def _replaced(expression: ca.SX, symbols: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.SX:
    """Expression with values in place of symbols."""
    return ca.substitute(ca.cse(expression), ca.vertcat(*symbols), ca.densify(ca.vertcat(*values)))


def link_axes(across_from: np.ndarray | ca.SX, z: ca.SX) -> ca.SX:
    """Axes (3, 3) of a link along the unit vector z.

    x is normal to a given direction and to z, and y = z x x.
    """
    across = ca.cross(ca.SX(across_from), z)
    x = across * (1 / ca.norm_2(across))
    return ca.horzcat(x, ca.cross(z, x), z)


def universal_spin(axis: np.ndarray | ca.SX, z: ca.SX, z_rate: ca.SX) -> ca.SX:
    """Angular velocity (3,) of a body on a universal joint, whose z moves at a rate (3,).

    The body turns about a first axis, a unit vector that stands still on the base, and about its
    own x (see `link_axes`).
    """
    across = ca.cross(ca.SX(axis), z)
    inverse = 1 / ca.dot(across, across)
    # About the first axis z moves along `across`, and along y about x.
    turn = ca.dot(z_rate, across) * inverse
    swing = ca.dot(z_rate, ca.cross(z, across)) * inverse
    return turn * axis - swing * across
