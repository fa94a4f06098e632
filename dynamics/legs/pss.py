"""Legs with a slider on the base (P) and a link from the slider to A.

The link has spherical joints (S) at both ends, or a universal joint (U) at the slider. The slider
does not rotate, and only its mass does work.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import casadi as ca
import numpy as np
from pydantic import Field

from dynamics.expressions import symmetric_from_lower
from dynamics.legs.crank_legs import Z
from dynamics.legs.full_leg_bodies import (
    LinkMotion,
    centred,
    link_forces,
    link_mass_matrix,
)
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


class PssLeg(Leg):
    """Slider that is at B if its coordinate is zero, and a link from the slider to A.

    The link does not spin about its length. The x axis of the link is perpendicular to the axis of
    the slider and to the link's length.
    """

    bodies = (Body("slider", (), driven="mass"), Body("link", ("Ixx", "Iyy")))
    prismatic = True
    numbers = (
        *(
            "base_joint.x",
            "base_joint.y",
            "base_joint.z",
            "slider_axis.u",
            "slider_axis.v",
            "link_length",
        ),
        *("platform_joint.x", "platform_joint.y", "platform_joint.z"),
    )
    turned = ("slider_axis",)
    link_joint: ClassVar[str] = "ball"

    type: Literal["pss"] = "pss"
    slider_axis: Direction = Field(
        description="direction of the slider for growing coordinates, unit vector, base axes"
    )
    link_length: Length = Field(description="from the slider to A, m")
    slider_length: Length = Field(
        0.040, description="length of the drawn slider, which can hide stickers, m"
    )
    slider_radius: Length = Field(
        0.014, description="radius of the drawn slider, which can hide stickers, m"
    )
    link_radius: Length = Field(
        0.006, description="radius of the drawn link, which can hide stickers, m"
    )

    @property
    def across_from(self) -> np.ndarray:
        """Direction (3,) to which the x axis of the link is perpendicular."""
        return self.slider_axis

    def lengths(self) -> str:
        return f"link {self.link_length:g} m"

    def shifted(self, by: float) -> Self:
        return self.model_copy(update={"base_joint": self.base_joint + by * self.slider_axis})

    def coordinate(self, position: ca.SX) -> ca.SX:
        along, across = self._parts(position)
        root = ca.sqrt(self.link_length**2 - ca.dot(across, across))
        return along - self.side * root

    def link(self, position: ca.SX) -> ca.SX:
        """Vector from the slider to A (3,), m."""
        _, across = self._parts(position)
        root = ca.sqrt(self.link_length**2 - ca.dot(across, across))
        return across + self.side * root * self.slider_axis

    def reach(self, position: ca.SX) -> ca.SX:
        """sin^2 of the angle between the link and the plane perpendicular to the slider's axis."""
        across = self._parts(position)[1]
        return 1 - ca.dot(across, across) / self.link_length**2

    def gap(self, position: ca.SX, coordinate: ca.SX) -> ca.SX:
        """Gap (|link|^2 - link_length^2) / 2."""
        link = position - self.base_joint - coordinate * self.slider_axis
        return (ca.dot(link, link) - self.link_length**2) / 2

    def direction(self, position: ca.SX) -> ca.SX:
        return self.link(position) * (1 / self.link_length)

    def leverage(self, position: ca.SX) -> ca.SX:
        """|cos| of the angle between link and slider axis."""
        return ca.fabs(ca.dot(self.link(position), self.slider_axis)) / self.link_length

    def gradient(self, position: ca.SX) -> ca.SX:
        link = self.link(position)
        return link * (1 / ca.dot(link, self.slider_axis))

    def acceleration(self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> ca.SX:
        gradient = self.gradient(position)
        link_rate = self._link_rate(position, velocity)
        # The length of the link is constant: link . A_ddot + |link_dot|^2 = link . axis s_ddot.
        stretch = ca.dot(link_rate, link_rate) / ca.dot(self.link(position), self.slider_axis)
        return ca.dot(gradient, acceleration) + stretch

    def placements(self, position: ca.SX) -> list[Placement]:
        link = self.link(position)
        axes = link_axes(self.across_from, link * (1 / self.link_length))
        return [Placement(position - link, ca.SX.eye(3)), Placement(position - link / 2, axes)]

    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        return [
            ca.SX.zeros(3),
            self._spin(self.link(position), self._link_rate(position, velocity)),
        ]

    def force(
        self,
        position: ca.SX,
        velocity: ca.SX,
        acceleration: ca.SX,
        parameters: Sequence[ca.SX],
        gravity: ca.DM,
    ) -> ca.SX:
        slider, ten = parameters
        if centred([ten]) or self._link_spins:
            return super().force(position, velocity, acceleration, parameters, gravity)
        gradient = self.gradient(position)
        link = self.link(position)
        link_rate = self._link_rate(position, velocity)
        of_slider = self.acceleration(position, velocity, acceleration) * self.slider_axis
        of_link = acceleration - of_slider
        motion = LinkMotion(
            tip_acceleration=of_slider,
            link_acceleration=of_link,
            angular_velocity=self._spin(link, link_rate),
            angular_acceleration=self._spin(link, of_link),
        )
        axes = link_axes(self.across_from, link * (1 / self.link_length))
        pull, turn = link_forces(axes, self.link_length, motion, ten, gravity)
        thrust = slider[0] * (of_slider - gravity) + pull - turn
        return pull + turn + gradient * ca.dot(self.slider_axis, thrust)

    def mass(self, position: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
        slider, ten = parameters
        if centred([ten]) or self._link_spins:
            return super().mass(position, parameters)
        gradient = self.gradient(position)
        axes = link_axes(self.across_from, self.link(position) * (1 / self.link_length))
        link_part = link_mass_matrix(axes, self.link_length, ca.SX(self.slider_axis), gradient, ten)
        reflected = (slider[0] + ten[0] / 4) * (gradient @ gradient.T)
        return symmetric_from_lower(reflected + link_part)

    @property
    def _link_spins(self) -> bool:
        """True if the link turns about its own length."""
        return "Izz" in self.bodies[1].moments

    def segments(self) -> list[Segment]:
        origin = np.zeros(3)
        end = self.link_length * Z
        half = self.slider_length / 2 * self.slider_axis
        slider = np.array([-half, half])
        link = np.array([origin, end])
        return [
            Segment(
                "slide",
                self.slider_axis,
                self.base_joint,
                origin,
                slider,
                self.slider_radius,
                actuated=True,
            ),
            Segment(
                self.link_joint, self.across_from, origin, end / 2, link, self.link_radius, end
            ),
        ]

    def _spin(self, link: ca.SX, link_rate: ca.SX) -> ca.SX:
        """Angular velocity of the link."""
        return ca.cross(link, link_rate) / self.link_length**2

    def _link_rate(self, position: ca.SX, velocity: ca.SX) -> ca.SX:
        """Time derivative of the link vector."""
        return velocity - ca.dot(self.gradient(position), velocity) * self.slider_axis

    def _parts(self, position: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Parts of the vector from B to A: component along the slider's axis, and the rest (3,)."""
        reach = position - self.base_joint
        axis = self.slider_axis
        along = ca.dot(reach, axis)
        return along, reach - along * axis


class PusLeg(PssLeg):
    """Slider and a link on a universal joint, which determines the spin of the link.

    The x axis of the link is perpendicular to the first axis of the joint and to the link's length.
    """

    bodies = (Body("slider", (), driven="mass"), Body("link", ("Ixx", "Iyy", "Izz")))
    link_joint: ClassVar[str] = "universal"

    type: Literal["pus"] = "pus"  # type: ignore[assignment]
    joint_axis: Direction = Field(
        description="first axis of the universal joint, unit vector, base axes"
    )

    @property
    def across_from(self) -> np.ndarray:
        """Direction (3,) to which the x axis of the link is perpendicular."""
        return self.joint_axis

    def _spin(self, link: ca.SX, link_rate: ca.SX) -> ca.SX:
        """Angular velocity of the link."""
        return universal_spin(
            self.joint_axis, link / self.link_length, link_rate / self.link_length
        )
