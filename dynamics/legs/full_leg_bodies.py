"""Force and mass matrix of a crank and a link with ten inertial parameters each (CasADi).

Legs with a slider use the functions for the link as well (`legs.pss`).

The crank only rotates about its axis z. Let r be its length, theta its angle, x the axis along the
crank, y the third axis of the crank, and g gravity. To the torque about z, its first moments m_x
and m_y add

    m_x (r theta_ddot - y . g) + m_y x . g

The link does not spin about its length. In the axes of the link, its angular velocity is (p, q, 0),
and only the components x and y of the moment do work.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca

from dynamics.expressions import symmetric_from_lower
from dynamics.legs.leg import link_axes
from dynamics.spatial_inertia import INERTIAL

if TYPE_CHECKING:
    from dynamics.legs.crank_legs import LegMotion, LegVectors


@dataclass(frozen=True)
class LinkMotion:
    """Motion of a link from T to A, which does not spin about its own length.

    `tip_acceleration` and `link_acceleration` (3,) are those of T, and of A relative to T, m/s^2.
    `angular_velocity` and `angular_acceleration` (3,) are those of the link.
    """

    tip_acceleration: ca.SX
    link_acceleration: ca.SX
    angular_velocity: ca.SX
    angular_acceleration: ca.SX


def centred(parameters: Sequence[ca.SX]) -> bool:
    """Return True if all bodies are centred, with four parameters."""
    return all(body.numel() == len(INERTIAL) for body in parameters)


def full_force(
    leg: "LegVectors",
    motion: "LegMotion",
    gradient: ca.SX,
    parameters: Sequence[ca.SX],
    gravity: ca.DM,
) -> ca.SX:
    """Force at A (3,), N, that is needed for the motion of crank and link.

    `gradient` (3,) is that of the crank angle with respect to A. `parameters` has the inertial
    parameters of crank and link, 4 or 10 each.
    """
    mass, mx, my, *_, izz = ca.vertsplit(_ten(parameters[0])[:7])
    tangent = ca.cross(leg.axis, leg.crank)
    along = ca.dot(leg.crank, gravity) * (1 / leg.crank_length)
    across = ca.dot(tangent, gravity) * (1 / leg.crank_length)
    lever = ca.dot(tangent / 2, motion.tip_acceleration / 2 - gravity)
    torque = mass * lever + izz * motion.crank_acceleration
    torque += mx * (leg.crank_length * motion.crank_acceleration - across) + my * along
    axes = link_axes(leg.axis, leg.link * (1 / leg.link_length))
    pull, turn = link_forces(axes, leg.link_length, motion, _ten(parameters[1]), gravity)
    return pull + turn + gradient * (torque + ca.dot(tangent, pull - turn))


def link_forces(
    axes: ca.SX, length: float, motion: LinkMotion, ten: ca.SX, gravity: ca.DM
) -> tuple[ca.SX, ca.SX]:
    """Forces (3,) `pull` and `turn` by which a link is moved: pull + turn at A, pull - turn at T.

    `axes` (3, 3) are those of the link. `ten` (10,) are its inertial parameters. In these axes,
    p, q are components of the angular velocity, u, v of the angular acceleration, and x, y, z of
    the acceleration of the middle relative to gravity.
    """
    mass, sx, sy, sz, xx, yy, _, xy, xz, yz = ca.vertsplit(ten)
    p, q = (ca.dot(axes[:, k], motion.angular_velocity) for k in range(2))
    u, v = (ca.dot(axes[:, k], motion.angular_acceleration) for k in range(2))
    acceleration = motion.tip_acceleration + motion.link_acceleration / 2 - gravity
    x, y, z = ca.vertsplit(axes.T @ acceleration)
    spin_moment = p * sx + q * sy
    square = p * p + q * q
    push = ca.vertcat(
        mass * x + v * sz + p * spin_moment - sx * square,
        mass * y - u * sz + q * spin_moment - sy * square,
        mass * z + u * sy - v * sx - sz * square,
    )
    spun = xz * p + yz * q
    moment_x = sy * z - sz * y + xx * u + xy * v + q * spun
    moment_y = sz * x - sx * z + xy * u + yy * v - p * spun
    return axes @ push / 2, (moment_y * axes[:, 0] - moment_x * axes[:, 1]) * (1 / length)


def full_mass(leg: "LegVectors", gradient: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
    """Mass matrix (3, 3) of crank and link at A. For the arguments see `full_force`."""
    mass, mx, *_, izz = ca.vertsplit(_ten(parameters[0])[:7])
    link_mass = parameters[1][0]
    tangent = ca.cross(leg.axis, leg.crank)
    radius = leg.crank_length
    reflected = izz + mx * radius + (mass + link_mass) * (radius**2 / 4)
    axes = link_axes(leg.axis, leg.link * (1 / leg.link_length))
    link_part = link_mass_matrix(axes, leg.link_length, tangent, gradient, _ten(parameters[1]))
    return symmetric_from_lower(reflected * (gradient @ gradient.T) + link_part)


def link_mass_matrix(
    axes: ca.SX, length: float, tangent: ca.SX, gradient: ca.SX, ten: ca.SX
) -> ca.SX:
    """Mass matrix (3, 3) of a link at A, without the part of its mass that is reflected at T.

    T moves by `tangent` (3,) times the rate of the coordinate, whose gradient (3,) is `gradient`.
    The reflected part is gradient gradient^T times mass |tangent|^2 / 4.
    """
    mass, sx, sy, sz, xx, yy, _, xy, *_ = ca.vertsplit(ten)
    half = gradient @ (mass / 4 * tangent).T
    total = mass / 4 * ca.SX.eye(3) + half + half.T
    # rows of the angular velocities p and q, and of the velocity of the middle, in the link's axes
    by_tip = [ca.dot(tangent, axes[:, k]) for k in range(3)]
    moving = [(axes[:, k] + by_tip[k] * gradient) / 2 for k in range(3)]
    x, y = ((axes[:, k] - by_tip[k] * gradient) * (1 / length) for k in range(2))
    p, q = -y, x
    total += xx * (p @ p.T) + yy * (q @ q.T)
    mixed = xy * (p @ q.T) + moving[2] @ (sy * p - sx * q).T
    mixed += sz * (moving[0] @ q.T - moving[1] @ p.T)
    return total + mixed + mixed.T


def _ten(body: ca.SX) -> ca.SX:
    """Parameters (10,) of a body. Those that a centred body does not have are zero."""
    if not centred([body]):
        return body
    return ca.vertcat(body[0], ca.SX(3, 1), body[1:], ca.SX(3, 1))
