"""Friction of the passive joints of the legs, from the relative angular velocity of their bodies.

Let w (3,) be the angular velocity of the outer body of a joint relative to the inner one, and W
(3, 6) its derivatives with respect to the twist of the platform. Viscous friction with the moment
c w dissipates the power c |w|^2. The wrench c W^T w at the platform overcomes it. Dry friction has
the moment c w / |w|. It fades below the angular velocity `SLOW`, so that the equation of motion
stays smooth:

    viscous   c W^T w
    coulomb   c W^T w / sqrt(|w|^2 + SLOW^2)

A joint of two parallel bars counts twice.
"""

import casadi as ca

from dynamics.geometry import AnyGeometry, RobotGeometry
from dynamics.parameter_units import PASSIVE_JOINT
from dynamics.rigid_body.jacobians import platform_arms

SLOW = 0.02  # relative angular velocity, rad/s, below which dry friction of a passive joint fades


def passive_friction_columns(geometry: AnyGeometry, pose: ca.SX, twist: ca.SX) -> ca.SX:
    """Wrenches (6, k) at the platform that overcome passive friction, for a unit of each parameter.

    The parameters are those in `layout.passive_names`, in this order.
    """
    names = geometry.layout.passive_names
    columns = ca.SX.zeros(6, len(names))
    if not names:
        return columns
    moving = ca.SX.sym("twist", 6)
    for joints, relative, count in _relative_spins(geometry, pose, moving):
        by_twist = ca.jacobian(relative, moving)
        spin = ca.substitute(relative, moving, ca.densify(twist))
        viscous = count * (by_twist.T @ spin)
        wrenches = {
            "viscous": viscous,
            "coulomb": viscous / ca.sqrt(ca.dot(spin, spin) + SLOW**2),
        }
        for law, wrench in wrenches.items():
            for name in (f"{joint}.{law}" for joint in joints):
                if name in names:
                    columns[:, names.index(name)] += wrench
    return columns


def _relative_spins(
    geometry: AnyGeometry, pose: ca.SX, twist: ca.SX
) -> list[tuple[tuple[str, str], ca.SX, int]]:
    """Names, relative angular velocity (3,) and number of parallel joints of each passive joint.

    The first name is that of the joint in all legs, and the second that of the joint in this leg.
    """
    nominal = geometry if isinstance(geometry, RobotGeometry) else geometry.nominal
    joints = []
    arms = platform_arms(geometry, pose)
    for number, (leg, nominal_leg, arm) in enumerate(
        zip(geometry.legs, nominal.legs, arms, strict=True), start=1
    ):
        velocity = twist[0:3] + ca.cross(twist[3:6], arm)
        spins = leg.angular_velocities(pose[0:3] + arm, velocity)
        before = ca.SX.zeros(3)
        segments = nominal_leg.segments()
        for body, segment, spin in zip(leg.bodies, segments, spins, strict=True):
            if segment.passive:
                joints.append((_names(body.name, number), spin - before, len(segment.copies)))
            before = spin
        joints.append((_names("platform", number), twist[3:6] - before, len(segments[-1].copies)))
    return joints


def _names(body: str, number: int) -> tuple[str, str]:
    return PASSIVE_JOINT.format(body), PASSIVE_JOINT.format(f"{body}{number}")
