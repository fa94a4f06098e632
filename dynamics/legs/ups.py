"""UPS leg of Gough-Stewart platforms: universal joint (U) at B, cylinder and rod (P), joint A (S).

The first axis of the universal joint is fixed on the base. The leg rotates about this axis and
about its own x. Cylinder and rod have the same rotation. Hence the motion depends only on the sums
of their moments of inertia, about all three axes.
"""

from __future__ import annotations

from typing import Literal, Self

import casadi as ca
import numpy as np
from pydantic import Field

from dynamics.legs.crank_legs import Z
from dynamics.legs.leg import (
    Body,
    Direction,
    Leg,
    Length,
    Placement,
    Segment,
    link_axes,
    universal_spin,
)


class UpsLeg(Leg):
    """Cylinder on the base, and a rod that slides in it and ends in the platform joint A."""

    bodies = (Body("cylinder", ("Ixx", "Iyy", "Izz")), Body("rod", ("Ixx", "Iyy", "Izz")))
    prismatic = True
    numbers = (
        *("base_joint.x", "base_joint.y", "base_joint.z", "zero_length"),
        *("platform_joint.x", "platform_joint.y", "platform_joint.z"),
    )

    type: Literal["ups"] = "ups"
    joint_axis: Direction = Field(
        description="first axis of the universal joint, unit vector, base axes"
    )
    zero_length: Length = Field(description="distance from B to A at coordinate zero, m")
    cylinder_centre: Length = Field(description="from B to the centre of mass of the cylinder, m")
    rod_centre: Length = Field(description="from A back to the centre of mass of the rod, m")
    cylinder_length: Length = Field(description="length of the cylinder, which begins at B, m")
    rod_length: Length = Field(description="length of the rod, which ends at A, m")
    cylinder_radius: Length = Field(
        0.014, description="radius of the drawn cylinder, which can hide stickers, m"
    )
    rod_radius: Length = Field(
        0.008, description="radius of the drawn rod, which can hide stickers, m"
    )

    @property
    def stroke(self) -> tuple[float, float]:
        """Shortest and longest distance of A from B, m.

        In this range, the rod does not protrude beyond B, the cylinder does not protrude beyond A,
        and the rod remains in the cylinder.
        """
        return max(self.cylinder_length, self.rod_length), self.cylinder_length + self.rod_length

    @property
    def travel_room(self) -> float:
        """Distance, m, of coordinate zero from the nearer end of the stroke."""
        shortest, longest = self.stroke
        return min(self.zero_length - shortest, longest - self.zero_length)

    def lengths(self) -> str:
        shortest, longest = self.stroke
        return (
            f"leg {shortest:g} to {longest:g} m (cylinder {self.cylinder_length:g}, rod "
            f"{self.rod_length:g})"
        )

    def shifted(self, by: float) -> Self:
        return self.model_copy(update={"zero_length": self.zero_length + by})

    def coordinate(self, position: ca.SX) -> ca.SX:
        beyond = ca.if_else(self.reach(position) > 0, 0, ca.DM.nan())
        return ca.norm_2(position - self.base_joint) - self.zero_length + beyond

    def reach(self, position: ca.SX) -> ca.SX:
        """Reach margin: 1 at mid-stroke, 0 at both ends of the stroke."""
        shortest, longest = self.stroke
        length = ca.norm_2(position - self.base_joint)
        return (length - shortest) * (longest - length) * (2 / (longest - shortest)) ** 2

    def gap(self, position: ca.SX, coordinate: ca.SX) -> ca.SX:
        """Gap (|A - B|^2 - length^2) / 2."""
        along = position - self.base_joint
        return (ca.dot(along, along) - (coordinate + self.zero_length) ** 2) / 2

    def direction(self, position: ca.SX) -> ca.SX:
        along = position - self.base_joint
        return along * (1 / ca.norm_2(along))

    def leverage(self, position: ca.SX) -> ca.SX:
        """Leverage, which is 1 because the actuator pushes along the leg."""
        return ca.SX(1)

    def gradient(self, position: ca.SX) -> ca.SX:
        return self.direction(position)

    def acceleration(self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        along = position - self.base_joint
        inverse = 1 / ca.norm_2(along)
        z = along * inverse
        across = velocity - ca.dot(z, velocity) * z
        return ca.dot(z, acceleration) + ca.dot(across, across) * inverse

    def placements(self, position: ca.SX) -> list[Placement]:
        z = self.direction(position)
        axes = link_axes(self.joint_axis, z)
        cylinder = Placement(ca.SX(self.base_joint) + self.cylinder_centre * z, axes)
        return [cylinder, Placement(position - self.rod_centre * z, axes)]

    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        along = position - self.base_joint
        # the component of the velocity along the leg cancels in both dot products
        inverse = 1 / ca.norm_2(along)
        return 2 * [universal_spin(self.joint_axis, along * inverse, velocity * inverse)]

    def segments(self) -> list[Segment]:
        origin = np.zeros(3)
        cylinder = self.cylinder_length * Z
        rod = -self.rod_length * Z
        centres = (self.cylinder_centre * Z, -self.rod_centre * Z)
        zero = self.zero_length * Z
        ends = np.array([origin, cylinder]), np.array([rod, origin])
        return [
            Segment(
                "universal",
                self.joint_axis,
                self.base_joint,
                centres[0],
                ends[0],
                self.cylinder_radius,
            ),
            Segment("slide", Z, zero, centres[1], ends[1], self.rod_radius, origin, actuated=True),
        ]
