"""Dynamics of one RSS leg as its platform joint A feels it: a function of the motion of A alone, in CasADi.

Crank and link move as A makes them move (eq. 5-16), so each leg adds a force at A, and the robot's wrench is the sum
of the platform's own and [F; a x F] over the legs. It is the virtual-work model of eq. 23 with the Jacobians taken
with respect to the velocity of A (3 columns) in place of the twist (6 columns), at a fraction of the operations; their
rates, Appendix A of the paper, are automatic derivatives (eq. A5 and A6 as printed are not). Crank and link parameters
are mass, Ixx, Iyy, Izz (4,) each, centres of mass at mid-length. All vectors in base axes; SI units.
"""

from dataclasses import dataclass

import casadi as ca

from dynamics.expressions import symmetric_from_lower
from dynamics.legs.rss_inverse_kinematics import LegVectors, angle_gradient, crank_leverage


@dataclass(frozen=True)
class LegMotion:
    """Crank acceleration (scalar), second derivatives of crank and link vectors (3,), and the link's angular
    velocity and acceleration (3,); the link does not spin about its own axis."""

    crank_acceleration: ca.SX
    tip_acceleration: ca.SX
    link_acceleration: ca.SX
    angular_velocity: ca.SX
    angular_acceleration: ca.SX


def leg_motion(leg: LegVectors, velocity: ca.SX, acceleration: ca.SX) -> LegMotion:
    """Motion of crank and link for a velocity (3,) and an acceleration (3,) of A."""
    gradient, tangent = angle_gradient(leg), ca.cross(leg.axis, leg.crank)
    rate = ca.dot(gradient, velocity)
    link_rate = velocity - rate * tangent
    # l . A_ddot + |l_dot|^2 = l . w_ddot: the link keeps its length.
    stretch = ca.dot(link_rate, link_rate) + rate**2 * ca.dot(leg.link, leg.crank)
    crank_acceleration = ca.dot(gradient, acceleration) + stretch * (1 / crank_leverage(leg))
    tip_acceleration = crank_acceleration * tangent - rate**2 * leg.crank
    link_acceleration = acceleration - tip_acceleration
    per_square = 1 / leg.link_length**2
    return LegMotion(
        crank_acceleration,
        tip_acceleration,
        link_acceleration,
        ca.cross(leg.link, link_rate) * per_square,
        ca.cross(leg.link, link_acceleration) * per_square,
    )


def leg_columns(leg: LegVectors, motion: LegMotion, gravity: ca.DM) -> ca.SX:
    """Force at A (3, 8) for unit crank mass, Ixx, Iyy, Izz and link mass, Ixx, Iyy, Izz: the derivatives of
    `leg_force`, which is linear in the parameters."""
    parameters = ca.SX.sym("parameters", 8)
    return ca.jacobian(leg_force(leg, motion, parameters[0:4], parameters[4:8], gravity), parameters)


def leg_force(leg: LegVectors, motion: LegMotion, crank: ca.SX, link: ca.SX, gravity: ca.DM) -> ca.SX:
    """Force at A (3,), N, that moves crank and link, for their parameters (mass, Ixx, Iyy, Izz) each (4,)."""
    gradient, tangent = angle_gradient(leg), ca.cross(leg.axis, leg.crank)
    # The crank turns about its own z alone, and a link without spin about l does no work against Izz.
    lever = ca.dot(tangent / 2, motion.tip_acceleration / 2 - gravity)
    torque = crank[0] * lever + crank[3] * motion.crank_acceleration
    pull = link[0] * (motion.tip_acceleration + motion.link_acceleration / 2 - gravity) / 2
    moment = ca.SX.zeros(3)
    for inertia, direction in zip((link[1], link[2]), link_axes(leg), strict=True):
        spin = ca.dot(direction, motion.angular_velocity)
        turning = ca.dot(direction, motion.angular_acceleration)
        moment += inertia * (direction * turning + ca.cross(motion.angular_velocity, direction) * spin)
    turn = ca.cross(moment, leg.link) * (1 / leg.link_length**2)
    return pull + turn + gradient * (torque + ca.dot(tangent, pull - turn))


def leg_mass(leg: LegVectors, crank: ca.SX, link: ca.SX) -> ca.SX:
    """Mass (3, 3) the leg adds at A, for crank and link parameters (mass, Ixx, Iyy, Izz) each (4,)."""
    gradient, tangent = angle_gradient(leg), ca.cross(leg.axis, leg.crank)
    reflected = crank[3] + (crank[0] + link[0]) * (leg.crank_length**2 / 4)
    half = gradient @ (link[0] / 4 * tangent).T
    total = reflected * (gradient @ gradient.T) + link[0] / 4 * ca.SX.eye(3) + half + half.T
    # Turning about x moves A along -y and the other way round, less what the crank takes up (eq. 13).
    x, y = link_axes(leg)
    for inertia, direction in ((link[1], y), (link[2], x)):
        row = direction - gradient * ca.dot(tangent, direction)
        total += (inertia * (1 / leg.link_length**2)) * (row @ row.T)
    return symmetric_from_lower(total)


def leg_coriolis(leg: LegVectors, crank: ca.SX, link: ca.SX, position: ca.SX, velocity: ca.SX) -> tuple[ca.SX, ca.SX]:
    """C (3, 3) of one leg for the position and velocity symbols (3,) of A: C velocity is the Coriolis and centrifugal
    force at A; and the mass (3, 3) that goes with it. Eq. 21 and 22: sums of J^T (M_body J_dot + C_body J)."""
    gradient, tangent = angle_gradient(leg), ca.cross(leg.axis, leg.crank)
    to_tip = tangent @ gradient.T
    to_centre = (ca.SX.eye(3) + to_tip) / 2
    to_spin = ca.skew(leg.link) @ (ca.SX.eye(3) - to_tip) / leg.link_length**2
    gradient_rate, centre_rate, spin_rate = (
        ca.reshape(ca.jtimes(ca.vec(matrix), position, velocity), matrix.shape)
        for matrix in (gradient, to_centre, to_spin)
    )
    x, y = link_axes(leg)
    inertia = link[1] * (x @ x.T) + link[2] * (y @ y.T)
    reflected = crank[3] + crank[0] * (leg.crank_length**2 / 4)
    coriolis = reflected * (gradient @ gradient_rate.T) + link[0] * (to_centre.T @ centre_rate)
    coriolis += to_spin.T @ (inertia @ spin_rate + ca.skew(to_spin @ velocity) @ inertia @ to_spin)
    return coriolis, leg_mass(leg, crank, link)


def link_axes(leg: LegVectors) -> tuple[ca.SX, ca.SX]:
    """The link's x and y axes (3,) each: z from T to A, x = s x z normalised, y = z x x."""
    z = leg.link * (1 / leg.link_length)
    across = ca.cross(leg.axis, z)
    x = across * (1 / ca.norm_2(across))
    return x, ca.cross(z, x)
