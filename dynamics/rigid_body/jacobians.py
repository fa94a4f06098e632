"""Inverse kinematics, Jacobians, singularities and loop closure of a robot from its legs (CasADi).

With J_a1 and J_a2 of eq. 7, diag(J_a1) theta_dot = J_a2 twist. Then J_ad = J_a1^-1 J_a2 (eq. 8),
and J_theta = J_ad T is the Jacobian for pose rates (eq. 29). A pose has six entries even if the
platform has fewer degrees of freedom (see `kinematics.platform.Chart`).
"""

import casadi as ca
import numpy as np

from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import pose_rate_to_twist, rotation_matrix


def pose_basis(geometry: AnyGeometry) -> ca.DM:
    """Basis (6, m) of the allowed pose changes, and of the allowed twists, as a sparse matrix."""
    return ca.sparsify(ca.DM(geometry.chart.basis))


def platform_arms(geometry: AnyGeometry, pose: ca.SX) -> list[ca.SX]:
    """Vectors a (3,) from the platform origin to its joints, in the axes of the base, m."""
    rotation = rotation_matrix(pose[3:6])
    return [rotation @ leg.platform_joint for leg in geometry.legs]


def joint_coordinates(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Joint coordinates (n,), rad or m, at a pose (6,).

    Entries of legs that cannot reach the pose are NaN.
    """
    arms = platform_arms(geometry, pose)
    return ca.vertcat(
        *[leg.coordinate(pose[0:3] + arm) for leg, arm in zip(geometry.legs, arms, strict=True)]
    )


def reach_margin(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Reach margins (n,), without unit. They are negative for legs that cannot reach the pose."""
    arms = platform_arms(geometry, pose)
    return ca.vertcat(
        *[leg.reach(pose[0:3] + arm) for leg, arm in zip(geometry.legs, arms, strict=True)]
    )


def joint_jacobian(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Jacobian J_ad (n, 6), with theta_dot = J_ad twist (eq. 8)."""
    rows = []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        along, divisor = leg.line(pose[0:3] + arm)
        rows.append(ca.horzcat(along.T, ca.cross(arm, along).T) / divisor)
    return ca.vertcat(*rows)


def pose_jacobian(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Jacobian J_theta (n, 6), with theta_dot = J_theta pose_dot (eq. 29)."""
    return joint_jacobian(geometry, pose) @ pose_rate_to_twist(pose)


def placements(geometry: AnyGeometry, pose: ca.SX, twist: ca.SX) -> ca.SX:
    """Placements (bodies, 15) of the bodies of all legs, leg by leg, in the axes of the base.

    A row has the reference point, m, the axes (3, 3) by rows, and the angular velocity, rad/s.
    """
    rows = []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        position = pose[0:3] + arm
        velocity = twist[0:3] + ca.cross(twist[3:6], arm)
        placed = zip(
            leg.placements(position), leg.angular_velocities(position, velocity), strict=True
        )
        # `vec` lists a matrix by columns, and the columns of the transpose are the rows
        rows += [
            ca.vertcat(placement.centre, ca.vec(placement.axes.T), spin).T
            for placement, spin in placed
        ]
    return ca.vertcat(*rows)


def singularity_measures(geometry: AnyGeometry, pose: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Leverage (n,) of each actuator on its leg, in 0..1, and J_a2 (n, m) without unit.

    Row i of J_a2 is [d, a x d] for the unit vector d of the force of leg i. Each column is for one
    twist that the platform can have. Entries of rotations are divided by the characteristic length.
    """
    leverages = []
    rows = []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        direction = leg.direction(pose[0:3] + arm)
        leverages.append(leg.leverage(pose[0:3] + arm))
        rows.append(ca.horzcat(direction.T, ca.cross(arm, direction).T))
    scale = np.repeat([1.0, 1 / geometry.characteristic_length], 3)
    return ca.vertcat(*leverages), ca.vertcat(*rows) @ ca.diag(ca.DM(scale)) @ pose_basis(geometry)


def loop_closure(geometry: AnyGeometry, pose: ca.SX, joints: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Gaps (n,), m^2, of the loops of eq. 3 and 4, at a pose and any joint coordinates.

    Also returns the derivatives (n, m) of the gaps with respect to the platform's coordinates.
    """
    arms = platform_arms(geometry, pose)
    legs = enumerate(zip(geometry.legs, arms, strict=True))
    gap = ca.vertcat(*[leg.gap(pose[0:3] + arm, joints[k]) for k, (leg, arm) in legs])
    return gap, ca.jacobian(gap, pose) @ pose_basis(geometry)
