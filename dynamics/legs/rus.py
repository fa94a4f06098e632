"""RUS leg: a crank on the base (R), and a link from a universal joint (U) at its tip to A (S).

The first axis of the universal joint is parallel to that of the crank. Both keep their direction in
the axes of the base, and the link turns about that and about its own x. Its spin about its length
follows, and all three of its moments do work.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import casadi as ca

from dynamics.legs.leg import Body, Leg, universal_spin
from dynamics.legs.rss import RssLeg, angle_gradient


class RusLeg(RssLeg):
    """Crank that turns about an axis on the base, and a link on a universal joint at its tip T."""

    bodies = (Body("crank", ("Izz",), driven="Izz"), Body("link", ("Ixx", "Iyy", "Izz")))
    link_joint: ClassVar[str] = "universal"
    type: Literal["rus"] = "rus"  # type: ignore[assignment]

    def angular_velocities(self, position: ca.SX, velocity: ca.SX) -> list[ca.SX]:
        leg = self.vectors(position)
        rate = ca.dot(angle_gradient(leg), velocity)
        link_rate = velocity - rate * ca.cross(leg.axis, leg.crank)
        spin = universal_spin(leg.axis, leg.link / leg.link_length, link_rate / leg.link_length)
        return [rate * leg.axis, spin]

    # the closed forms of RSS are those of a link that does not spin

    def force(
        self, position: ca.SX, velocity: ca.SX, acceleration: ca.SX, rigid: ca.SX, gravity: ca.DM
    ) -> ca.SX:
        return Leg.force(self, position, velocity, acceleration, rigid, gravity)

    def mass(self, position: ca.SX, rigid: ca.SX) -> ca.SX:
        return Leg.mass(self, position, rigid)
