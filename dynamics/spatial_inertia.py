"""Inertial parameters of a rigid body, and the forces that its motion needs, in CasADi.

A body moves with the velocity v and acceleration a of its reference point and the angular velocity
omega, in the axes of the base. Let m be its mass, s = m c the first moment of the mass about the
reference point, I the inertia about this point, and g gravity. Newton's and Euler's equations are

    force  = m (a - g) + omega_dot x s + omega x (omega x s)
    moment = s x (a - g) + I omega_dot + omega x I omega

The moment is about the reference point. All terms are linear in m, s and I. The centre of mass of a
centred body is the reference point, so that s is zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

MOMENTS = ("Ixx", "Iyy", "Izz")
# Inertial parameters of a centred body: mass, kg, and moments about its own axes, kg m^2.
INERTIAL = ("mass", *MOMENTS)

FIRST_MOMENTS = ("mcx", "mcy", "mcz")
PRODUCTS = ("Ixy", "Ixz", "Iyz")
# Inertial parameters of a full body: kg, kg m and kg m^2, in its own axes. The first moment of the
# mass is the mass times the vector from the reference point to the centre of mass. Moments and
# products of inertia are about the reference point, and Ixy is minus the integral of x y dm.
FULL_INERTIAL = ("mass", *FIRST_MOMENTS, *MOMENTS, *PRODUCTS)


@dataclass(frozen=True)
class SpatialInertia:
    """Mass, first moment (3,) and inertia (3, 3) of a body in the axes of the base.

    The first moment is None for a centred body.
    """

    mass: ca.SX
    first_moment: ca.SX | None
    inertia: ca.SX

    def load(self, acceleration: ca.SX, spin: ca.SX, spin_rate: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Force (3,), N, and moment (3,), N m, for a motion.

        `acceleration` (3,) is that of the reference point minus gravity. `spin` (3,) is the angular
        velocity, and `spin_rate` (3,) its time derivative.
        """
        force = self.mass * acceleration
        moment = self.inertia @ spin_rate + ca.cross(spin, self.inertia @ spin)
        if self.first_moment is not None:
            force += ca.cross(spin_rate, self.first_moment)
            force += ca.cross(spin, ca.cross(spin, self.first_moment))
            moment += ca.cross(self.first_moment, acceleration)
        return force, moment

    def mass_matrix(self, centre_map: ca.SX, spin_map: ca.SX) -> ca.SX:
        """Mass matrix (n, n) for maps (3, n) from n velocities to v and omega."""
        total = self.mass * (centre_map.T @ centre_map) + spin_map.T @ self.inertia @ spin_map
        if self.first_moment is not None:
            mixed = spin_map.T @ ca.skew(self.first_moment) @ centre_map
            total += mixed + mixed.T
        return total

    def coriolis_parts(
        self, maps: Sequence[ca.SX], map_rates: Sequence[ca.SX], velocity: ca.SX, spin: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Two matrices (n, n) whose sum is a Coriolis matrix C.

        The first is that of the forces, and the second that of the moments. M_dot - 2 C is
        skew-symmetric. `maps` are the two maps (3, n) of `mass_matrix`, and `map_rates` their time
        derivatives. `velocity` and `spin` (3,) are v and omega.
        """
        centre_map, spin_map = maps
        centre_rate, spin_rate = map_rates
        of_forces = self.mass * (centre_map.T @ centre_rate)
        of_moments = spin_map.T @ (
            self.inertia @ spin_rate + ca.skew(spin) @ self.inertia @ spin_map
        )
        if self.first_moment is not None:
            first = ca.skew(self.first_moment)
            turned = ca.skew(spin) @ first
            of_forces -= centre_map.T @ (first @ spin_rate + turned @ spin_map)
            of_moments += spin_map.T @ first @ centre_rate
            # these two terms cancel in C times the velocities, and make M_dot - 2 C skew-symmetric
            swept = ca.skew(ca.cross(self.first_moment, velocity))
            of_moments += spin_map.T @ (turned @ centre_map + swept @ spin_map)
        return of_forces, of_moments


def spatial_inertia(
    parameters: ca.SX, axes: ca.SX, working: Sequence[str] = MOMENTS
) -> SpatialInertia:
    """Inertia of a body with axes (3, 3), as columns, in the axes of the base.

    `parameters` are those of a centred body (4,) or of a full body (10,). `working` are the moments
    of a centred body that do work. Its other moments are set to zero, because they would only add
    rounding errors.
    """
    if parameters.numel() == len(INERTIAL):
        moments = [parameters[k] if name in working else 0 for k, name in enumerate(INERTIAL) if k]
        return SpatialInertia(parameters[0], None, axes @ ca.diag(ca.vertcat(*moments)) @ axes.T)
    xx, yy, zz, xy, xz, yz = ca.vertsplit(parameters[4:10])
    rows = [ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz)]
    inertia = axes @ ca.vertcat(*rows) @ axes.T
    return SpatialInertia(parameters[0], axes @ parameters[1:4], inertia)
