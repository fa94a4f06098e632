"""Inverse kinematics of a robot and its Jacobians (eq. 7, 8, 29), singularities and closure, from its legs (CasADi).

J_a1 and J_a2 (eq. 7): diag(J_a1) theta_dot = J_a2 twist; J_ad = J_a1^-1 J_a2 (eq. 8); J_theta = J_ad T maps pose rates
(eq. 29). A pose has six entries also where the platform has fewer freedoms; see `kinematics.chart`.
"""

import casadi as ca
import numpy as np

from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import pose_rate_to_twist, rotation_matrix


def freedoms(geometry: AnyGeometry) -> ca.DM:
    """d(pose)/d(coordinates) (6, m), which also spans the twists, without its zeros."""
    return ca.sparsify(ca.DM(geometry.chart.basis))


def platform_arms(geometry: AnyGeometry, pose: ca.SX) -> list[ca.SX]:
    """Vectors a from the platform origin to its joints (3,), base axes, m."""
    rotation = rotation_matrix(pose[3:6])
    return [rotation @ leg.platform_joint for leg in geometry.legs]


def joint_coordinates(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Actuated coordinates (n,), rad or m, at a pose (6,). Entries of a leg that cannot reach are NaN."""
    arms = platform_arms(geometry, pose)
    return ca.vertcat(*[leg.coordinate(pose[0:3] + arm) for leg, arm in zip(geometry.legs, arms, strict=True)])


def reach_margin(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """Reach margins (n,), dimensionless; negative: out of reach."""
    arms = platform_arms(geometry, pose)
    return ca.vertcat(*[leg.reach(pose[0:3] + arm) for leg, arm in zip(geometry.legs, arms, strict=True)])


def joint_jacobian(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """J_ad (n, 6): theta_dot = J_ad twist (eq. 8)."""
    rows = []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        along, divisor = leg.line(pose[0:3] + arm)
        rows.append(ca.horzcat(along.T, ca.cross(arm, along).T) / divisor)
    return ca.vertcat(*rows)


def pose_jacobian(geometry: AnyGeometry, pose: ca.SX) -> ca.SX:
    """J_theta (n, 6): theta_dot = J_theta pose_dot (eq. 29)."""
    return joint_jacobian(geometry, pose) @ pose_rate_to_twist(pose)


def placements(geometry: AnyGeometry, pose: ca.SX, twist: ca.SX) -> ca.SX:
    """Of the bodies of all legs, leg by leg (bodies, 15): centre of mass, m, axes (3, 3) row by row, and angular
    velocity, rad/s, base axes."""
    rows = []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        position, velocity = pose[0:3] + arm, twist[0:3] + ca.cross(twist[3:6], arm)
        found = zip(leg.placements(position), leg.angular_velocities(position, velocity), strict=True)
        rows += [ca.vertcat(place.centre, ca.vec(place.axes.T), spin).T for place, spin in found]
    return ca.vertcat(*rows)


def singularity_measures(geometry: AnyGeometry, pose: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Leverage of each actuator on its leg (n,), in 0..1; and J_a2 (n, n) without unit: for the twists that the
    platform can have, rows [d, a x d] of the unit vectors d along which the legs push, angular columns over the
    characteristic length."""
    leverages, rows = [], []
    for leg, arm in zip(geometry.legs, platform_arms(geometry, pose), strict=True):
        direction = leg.direction(pose[0:3] + arm)
        leverages.append(leg.leverage(pose[0:3] + arm))
        rows.append(ca.horzcat(direction.T, ca.cross(arm, direction).T))
    scale = np.repeat([1.0, 1 / geometry.characteristic_length], 3)
    return ca.vertcat(*leverages), ca.vertcat(*rows) @ ca.diag(ca.DM(scale)) @ freedoms(geometry)


def loop_closure(geometry: AnyGeometry, pose: ca.SX, joints: ca.SX) -> tuple[ca.SX, ca.SX]:
    """How far the loops of eq. 3 and 4 are from closed at a pose and joint coordinates chosen freely, and its
    derivative: gaps (n,) in m^2, and d(gaps)/d(coordinates of the platform) (n, n)."""
    arms = platform_arms(geometry, pose)
    legs = enumerate(zip(geometry.legs, arms, strict=True))
    gap = ca.vertcat(*[leg.gap(pose[0:3] + arm, joints[k]) for k, (leg, arm) in legs])
    return gap, ca.jacobian(gap, pose) @ freedoms(geometry)
