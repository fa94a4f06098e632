"""The paper's Jacobians (eq. 7-16 and 29), in CasADi. All map the twist [h_dot, omega] (6,), base axes.

J_a1, J_a2, J_ad: crank angle rates; J_a = [J_au; s J_ad]: crank centre of mass velocity and angular velocity;
J_b = [J_bu; J_bd]: link centre of mass velocity and angular velocity; J_theta: crank angle rates from pose rates.
Centres of mass lie at mid-length.
"""

import casadi as ca

from dynamics.geometry import Rss6Geometry
from dynamics.kinematics import LegVectors, leg_vectors, platform_arms
from dynamics.rotation import pose_rate_to_twist


def crank_leverage(leg: LegVectors) -> ca.SX:
    """Diagonal entry of J_a1, m^2: (w x l) . s (eq. 7). Zero where the leg is singular."""
    return ca.dot(ca.cross(leg.crank, leg.link), leg.axis)


def link_row(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """Row of J_a2 (1, 6): [l^T, (a x l)^T] (eq. 7)."""
    return ca.horzcat(leg.link.T, ca.cross(arm, leg.link).T)


def joint_row(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """Row of J_ad (1, 6): theta_dot_i = J_ad,i twist (eq. 8)."""
    return link_row(leg, arm) / crank_leverage(leg)


def joint_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_ad (6, 6): theta_dot = J_ad twist (eq. 8)."""
    legs, arms = leg_vectors(geometry, pose), platform_arms(geometry, pose)
    return ca.vertcat(*[joint_row(leg, arm) for leg, arm in zip(legs, arms, strict=True)])


def pose_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_theta (6, 6): theta_dot = J_theta pose_dot (eq. 29)."""
    return joint_jacobian(geometry, pose) @ pose_rate_to_twist(pose)


def crank_jacobian(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_a (6, 6): twist of the crank's centre of mass (eq. 9 and 10)."""
    row = joint_row(leg, arm)
    return ca.vertcat(ca.cross(leg.axis, leg.crank / 2) @ row, leg.axis @ row)


def link_jacobian(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_b (6, 6): twist of the link's centre of mass (eq. 13, 15 and 16)."""
    link, tip_row = ca.skew(leg.link), ca.skew(leg.crank) @ leg.axis @ joint_row(leg, arm)
    angular = (ca.horzcat(link, -link @ ca.skew(arm)) + link @ tip_row) / ca.dot(leg.link, leg.link)
    linear = -tip_row - ca.skew(leg.link / 2) @ angular
    return ca.vertcat(linear, angular)
