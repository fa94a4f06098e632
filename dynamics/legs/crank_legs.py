"""Legs with a crank on the base: RSS, RUS, parallelogram (Delta robots) and planar RRR.

The inverse kinematics is in closed form (eq. 3 and 4). The dynamics uses the Jacobians of eq. 5-16.
Rates of Jacobians (Appendix A of the paper) are computed by automatic differentiation, because eq.
A5 and A6 are misprinted. The vector a from the platform origin to joint A is in the axes of the
base: eq. 3 and 5 need R a, although the paper defines a in platform axes. Centres of mass are at
mid-length, unless a body has ten inertial parameters. Forces follow by virtual work, as for any
`Leg`. For a link that does not spin, they are here in closed form, which is faster.

The link of an RSS leg has two spherical joints (S). That of a RUS leg has a universal joint (U) at
the tip of the crank. The first axis of this joint is parallel to the crank axis, and thus fixed in
the axes of the base. The link rotates about this axis and about its own x. This determines its spin
about its length, and all three of its moments of inertia do work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import casadi as ca
import numpy as np
from pydantic import Field, model_validator

from dynamics.expressions import symmetric_from_lower
from dynamics.legs.full_leg_bodies import LinkMotion, centred, full_force, full_mass
from dynamics.legs.leg import (
    EXACT,
    ROUNDED,
    Body,
    Direction,
    Leg,
    Length,
    Placement,
    Segment,
    link_axes,
    universal_spin,
)

Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class LegVectors:
    """Vectors of one leg in the axes of the base, m.

    `angle` is the crank angle, rad. `axis` is the crank axis s, `crank` is w = T - B and `link` is
    l = A - T, (3,) each. T is the tip of the crank. The lengths are constants of the robot.
    """

    angle: ca.SX
    axis: ca.SX
    crank: ca.SX
    link: ca.SX
    crank_length: float
    link_length: float


@dataclass(frozen=True)
class LegMotion(LinkMotion):
    """Motion of crank and link. `crank_acceleration` is an angular acceleration, rad/s^2."""

    crank_acceleration: ca.SX


class RssLeg(Leg):
    """Crank that turns about an axis on the base, and a link from its tip T to A."""

    bodies = (Body("crank", ("Izz",), driven="Izz"), Body("link", ("Ixx", "Iyy")))
    prismatic = False
    numbers: ClassVar[tuple[str, ...]] = (
        *(
            "base_joint.x",
            "base_joint.y",
            "base_joint.z",
            "crank_axis.u",
            "crank_axis.v",
            "crank_zero",
        ),
        *(
            "crank_length",
            "link_length",
            "platform_joint.x",
            "platform_joint.y",
            "platform_joint.z",
        ),
    )
    turned = ("crank_axis", "crank_zero_direction")
    link_joint: ClassVar[str] = "ball"

    type: Literal["rss"] = "rss"
    crank_axis: Direction = Field(description="axis of the crank, unit vector, base axes")
    crank_zero_direction: Direction = Field(
        description="unit vector from B to the crank's tip at angle zero"
    )
    crank_length: Length = Field(description="from B to the crank's tip, m")
    link_length: Length = Field(description="from the crank's tip to A, m")
    crank_radius: Length = Field(
        0.010, description="radius of the drawn crank, which can hide stickers, m"
    )
    link_radius: Length = Field(
        0.006, description="radius of the drawn link, which can hide stickers, m"
    )

    @model_validator(mode="after")
    def _normal(self) -> Self:
        """Make the zero direction exactly perpendicular to the axis, or raise ValueError."""
        zero = self.crank_zero_direction
        axis = self.crank_axis
        product = float(axis @ zero)
        if abs(product) > ROUNDED:
            raise ValueError(
                "crank_zero_direction must be normal to the crank axis; their dot product is "
                f"{product:.3g}, limit {ROUNDED:g}"
            )
        if abs(product) > EXACT:
            normal = zero - product * axis
            self.__dict__["crank_zero_direction"] = normal / np.linalg.norm(normal)
            self.crank_zero_direction.setflags(write=False)
        return self

    def lengths(self) -> str:
        return f"crank {self.crank_length:g} m, link {self.link_length:g} m"

    def shifted(self, by: float) -> Self:
        zero = np.cos(by) * self.crank_zero_direction + np.sin(by) * np.cross(
            self.crank_axis, self.crank_zero_direction
        )
        return self.model_copy(update={"crank_zero_direction": zero / np.linalg.norm(zero)})

    def vectors(self, position: ca.SX) -> LegVectors:
        """Vectors of the leg for a position of A.

        The crank angle theta solves along cos(theta) + across sin(theta) = chord, on the branch of
        the leg. The three coefficients come from `_chord`.
        """
        zero = self.crank_zero_direction
        axis = self.crank_axis
        along, across, chord = self._chord(position)
        square = along**2 + across**2
        root = self.side * ca.sqrt(square - chord**2)
        inverse = 1 / square
        cosine = (along * chord - across * root) * inverse
        sine = (across * chord + along * root) * inverse
        crank = self.crank_length * (cosine * zero + sine * ca.cross(ca.SX(axis), ca.SX(zero)))
        link = position - self.base_joint - crank
        return LegVectors(
            ca.atan2(sine, cosine), ca.SX(axis), crank, link, self.crank_length, self.link_length
        )

    def coordinate(self, position: ca.SX) -> ca.SX:
        return self.vectors(position).angle

    def reach(self, position: ca.SX) -> ca.SX:
        """sin^2 of the angle between the crank and the direction to A in the plane of the crank."""
        along, across, chord = self._chord(position)
        return 1 - chord**2 / (along**2 + across**2)

    def gap(self, position: ca.SX, coordinate: ca.SX) -> ca.SX:
        """Gap (|A - T|^2 - link_length^2) / 2."""
        zero = ca.SX(self.crank_zero_direction)
        axis = ca.SX(self.crank_axis)
        crank = self.crank_length * (
            ca.cos(coordinate) * zero + ca.sin(coordinate) * ca.cross(axis, zero)
        )
        link = position - self.base_joint - crank
        return (ca.dot(link, link) - self.link_length**2) / 2

    def direction(self, position: ca.SX) -> ca.SX:
        return self.vectors(position).link * (1 / self.link_length)

    def leverage(self, position: ca.SX) -> ca.SX:
        """Leverage |J_a1| / (|w| |l|)."""
        return ca.fabs(crank_leverage(self.vectors(position))) / (
            self.crank_length * self.link_length
        )

    def gradient(self, position: ca.SX) -> ca.SX:
        return angle_gradient(self.vectors(position))

    def line(self, position: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Vector l (3,) of the link, and J_a1."""
        leg = self.vectors(position)
        return leg.link, crank_leverage(leg)

    def acceleration(self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        return leg_motion(self.vectors(position), velocity, acceleration).crank_acceleration

    def placements(self, position: ca.SX) -> list[Placement]:
        leg = self.vectors(position)
        x = leg.crank * (1 / leg.crank_length)
        crank = Placement(
            leg.crank / 2 + self.base_joint, ca.horzcat(x, ca.cross(leg.axis, x), leg.axis)
        )
        axes = link_axes(leg.axis, leg.link * (1 / leg.link_length))
        return [crank, Placement(leg.crank + leg.link / 2 + self.base_joint, axes)]

    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        leg = self.vectors(position)
        rate = ca.dot(angle_gradient(leg), velocity)
        link_rate = velocity - rate * ca.cross(leg.axis, leg.crank)
        return [rate * leg.axis, ca.cross(leg.link, link_rate) / leg.link_length**2]

    def driven_inertia(self, body: np.ndarray) -> float:
        """Inertia of the crank about its axis."""
        mass, along, *_ = body
        izz = body[6]
        return float(izz + along * self.crank_length + mass * self.crank_length**2 / 4)

    def segments(self) -> list[Segment]:
        origin = np.zeros(3)
        tip = np.array([self.crank_length, 0, 0])
        end = self.link_length * Z
        crank = np.array([origin, tip])
        return [
            Segment(
                "hinge",
                self.crank_axis,
                self.base_joint,
                tip / 2,
                crank,
                self.crank_radius,
                actuated=True,
            ),
            Segment(
                self.link_joint, Z, tip, end / 2, np.array([origin, end]), self.link_radius, end
            ),
        ]

    def force(
        self,
        position: ca.SX,
        velocity: ca.SX,
        acceleration: ca.SX,
        parameters: Sequence[ca.SX],
        gravity: ca.DM,
    ) -> ca.SX:
        if self._link_spins:
            return super().force(position, velocity, acceleration, parameters, gravity)
        leg = self.vectors(position)
        crank, link = parameters
        motion = leg_motion(leg, velocity, acceleration)
        gradient = angle_gradient(leg)
        if not centred(parameters):
            return full_force(leg, motion, gradient, parameters, gravity)
        tangent = ca.cross(leg.axis, leg.crank)
        # the crank rotates only about its own z; Izz of a link without spin about l does no work
        lever = ca.dot(tangent / 2, motion.tip_acceleration / 2 - gravity)
        torque = crank[0] * lever + crank[3] * motion.crank_acceleration
        pull = link[0] * (motion.tip_acceleration + motion.link_acceleration / 2 - gravity) / 2
        moment = ca.SX.zeros(3)
        for inertia, (direction, weight) in zip((link[1], link[2]), _link_xy(leg), strict=True):
            spin = ca.dot(direction, motion.angular_velocity)
            turning = ca.dot(direction, motion.angular_acceleration)
            moment += (inertia * weight) * (
                direction * turning + ca.cross(motion.angular_velocity, direction) * spin
            )
        turn = ca.cross(moment, leg.link) * (1 / leg.link_length**2)
        return pull + turn + gradient * (torque + ca.dot(tangent, pull - turn))

    def mass(self, position: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
        if self._link_spins:
            return super().mass(position, parameters)
        leg = self.vectors(position)
        crank, link = parameters
        gradient = angle_gradient(leg)
        if not centred(parameters):
            return full_mass(leg, gradient, parameters)
        tangent = ca.cross(leg.axis, leg.crank)
        reflected = crank[3] + (crank[0] + link[0]) * (leg.crank_length**2 / 4)
        half = gradient @ (link[0] / 4 * tangent).T
        total = reflected * (gradient @ gradient.T) + link[0] / 4 * ca.SX.eye(3) + half + half.T
        # Rotation about x moves A along -y, and about y along x. The motion of the crank is
        # subtracted (eq. 13).
        x, y = _link_xy(leg)
        for inertia, (direction, weight) in ((link[1], y), (link[2], x)):
            row = direction - gradient * ca.dot(tangent, direction)
            total += (inertia * weight * (1 / leg.link_length**2)) * (row @ row.T)
        return symmetric_from_lower(total)

    @property
    def _link_spins(self) -> bool:
        """True if the link turns about its own length."""
        return "Izz" in self.bodies[1].moments

    def _chord(self, position: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Components of the vector from B to A along and across the zero direction, and the chord.

        The chord is the component along the crank that the lengths of crank and link require. All
        are in m.
        """
        reach = position - self.base_joint
        zero = self.crank_zero_direction
        across = ca.cross(ca.SX(self.crank_axis), ca.SX(zero))
        radius = self.crank_length
        length = self.link_length
        chord = (ca.dot(reach, reach) + radius**2 - length**2) / (2 * radius)
        return ca.dot(reach, zero), ca.dot(reach, across), chord


class ParallelogramLeg(RssLeg):
    """Crank and a link of two equal bars, which keep the platform from rotating (Delta robots).

    The platform does not rotate, and neither does the line between the ends of the bars. Both bars
    move like the link of an RSS leg. The parameters of `link` are the sums over both bars.
    """

    chart: ClassVar[str] = "translation"
    type: Literal["parallelogram"] = "parallelogram"  # type: ignore[assignment]
    bar_distance: Length = Field(description="between the two bars of the parallelogram, m")

    def segments(self) -> list[Segment]:
        """Bodies as a chain from the base. The bars are side by side along the crank axis."""
        crank, link = super().segments()
        return [crank, link._replace(copies=np.outer([-0.5, 0.5], self.bar_distance * Z))]


class RrrLeg(RssLeg):
    """Crank and link in one plane, with three hinge axes normal to it (planar robots)."""

    bodies = (Body("crank", ("Izz",), driven="Izz"), Body("link", ("Iyy",)))
    numbers: ClassVar[tuple[str, ...]] = (
        *("base_joint.x", "base_joint.y", "crank_zero", "crank_length", "link_length"),
        *("platform_joint.x", "platform_joint.y"),
    )
    chart: ClassVar[str] = "planar"
    link_joint: ClassVar[str] = "hinge"
    type: Literal["rrr"] = "rrr"  # type: ignore[assignment]


def crank_leverage(leg: LegVectors) -> ca.SX:
    """Diagonal entry of J_a1, m^2: (w x l) . s (eq. 7). It is zero where the leg is singular."""
    return ca.dot(ca.cross(leg.crank, leg.link), leg.axis)


def angle_gradient(leg: LegVectors) -> ca.SX:
    """Gradient l / J_a1 (3,), 1/m, of the crank angle with respect to A.

    It is also the force at A due to a unit torque (eq. 8).
    """
    return leg.link * (1 / crank_leverage(leg))


def leg_motion(leg: LegVectors, velocity: ca.SX, acceleration: ca.SX) -> LegMotion:
    """Motion of crank and link for a velocity (3,) and an acceleration (3,) of A."""
    gradient = angle_gradient(leg)
    tangent = ca.cross(leg.axis, leg.crank)
    rate = ca.dot(gradient, velocity)
    link_rate = velocity - rate * tangent
    # The length of the link is constant: l . A_ddot + |l_dot|^2 = l . w_ddot.
    stretch = ca.dot(link_rate, link_rate) + rate**2 * ca.dot(leg.link, leg.crank)
    crank_acceleration = ca.dot(gradient, acceleration) + stretch * (1 / crank_leverage(leg))
    tip_acceleration = crank_acceleration * tangent - rate**2 * leg.crank
    link_acceleration = acceleration - tip_acceleration
    per_square = 1 / leg.link_length**2
    return LegMotion(
        tip_acceleration,
        link_acceleration,
        ca.cross(leg.link, link_rate) * per_square,
        ca.cross(leg.link, link_acceleration) * per_square,
        crank_acceleration,
    )


def _link_xy(leg: LegVectors) -> list[tuple[ca.SX, ca.SX]]:
    """Pairs for the x axis and the y axis of the link (see `link_axes`).

    Each pair has a vector (3,) along the axis and the reciprocal of its squared length.
    """
    across = ca.cross(leg.axis, leg.link)
    weight = 1 / ca.dot(across, across)
    return [(across, weight), (ca.cross(leg.link, across), weight * (1 / leg.link_length**2))]


class RusLeg(RssLeg):
    """Crank that rotates about an axis on the base, and a link on a universal joint at tip T."""

    bodies = (Body("crank", ("Izz",), driven="Izz"), Body("link", ("Ixx", "Iyy", "Izz")))
    link_joint: ClassVar[str] = "universal"
    type: Literal["rus"] = "rus"  # type: ignore[assignment]

    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        leg = self.vectors(position)
        rate = ca.dot(angle_gradient(leg), velocity)
        link_rate = velocity - rate * ca.cross(leg.axis, leg.crank)
        spin = universal_spin(leg.axis, leg.link / leg.link_length, link_rate / leg.link_length)
        return [rate * leg.axis, spin]
