"""The paper's Jacobians (eq. 7-16 and 29), in CasADi. All but J_theta map the twist [h_dot, omega] (6,), base axes.

J_a1, J_a2, J_ad: crank angle rates; J_a = [J_au; s J_ad]: crank centre of mass velocity and angular velocity;
J_b = [J_bu; J_bd]: link centre of mass velocity and angular velocity; J_theta: crank angle rates from pose rates.
J_e (eq. 2) is `rotation.euler_rate_jacobian`. Centres of mass lie at mid-length: c_w = w / 2, c_l = l / 2. The vector
a from the platform origin to joint A is in base axes throughout (eq. 3 and 5 need R a, though the text defines a in
platform axes).
"""

import casadi as ca

from dynamics.kinematics.geometry import Rss6Geometry
from dynamics.kinematics.inverse_kinematics import LegVectors, leg_vectors, platform_arms
from dynamics.kinematics.rotation import pose_rate_to_twist


def crank_leverage(leg: LegVectors) -> ca.SX:
    """Diagonal entry of J_a1, m^2: (w x l) . s (eq. 7). Zero where the leg is singular."""
    return ca.dot(ca.cross(leg.crank, leg.link), leg.axis)


def link_row(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """Row of J_a2 (1, 6): [l^T, (a x l)^T] (eq. 7)."""
    return ca.horzcat(leg.link.T, ca.cross(arm, leg.link).T)


def joint_row(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """Row of J_ad (1, 6): theta_dot_i = J_ad,i twist (eq. 8)."""
    return link_row(leg, arm) / crank_leverage(leg)


def loop_jacobians(geometry: Rss6Geometry, pose: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Diagonal of J_a1 (6,), m^2, and J_a2 (6, 6), m and m^2: diag(J_a1) theta_dot = J_a2 twist (eq. 7)."""
    legs, arms = leg_vectors(geometry, pose), platform_arms(geometry, pose)
    rows = [link_row(leg, arm) for leg, arm in zip(legs, arms, strict=True)]
    return ca.vertcat(*[crank_leverage(leg) for leg in legs]), ca.vertcat(*rows)


def joint_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_ad (6, 6): theta_dot = J_ad twist (eq. 8)."""
    legs, arms = leg_vectors(geometry, pose), platform_arms(geometry, pose)
    return ca.vertcat(*[joint_row(leg, arm) for leg, arm in zip(legs, arms, strict=True)])


def pose_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_theta (6, 6): theta_dot = J_theta pose_dot (eq. 29)."""
    return joint_jacobian(geometry, pose) @ pose_rate_to_twist(pose)


def crank_centre_rows(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_au (3, 6): velocity of the crank's centre of mass (eq. 9)."""
    return ca.cross(leg.axis, leg.crank / 2) @ joint_row(leg, arm)


def crank_jacobian(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_a (6, 6): twist of the crank's centre of mass (eq. 10)."""
    return ca.vertcat(crank_centre_rows(leg, arm), leg.axis @ joint_row(leg, arm))


def link_angular_rows(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_bd (3, 6): angular velocity of the link, which does not spin about its own axis (eq. 13)."""
    link, tip_row = ca.skew(leg.link), ca.skew(leg.crank) @ leg.axis @ joint_row(leg, arm)
    return (ca.horzcat(link, -link @ ca.skew(arm)) + link @ tip_row) / ca.dot(leg.link, leg.link)


def link_centre_rows(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_bu (3, 6): velocity of the link's centre of mass (eq. 15)."""
    tip_row = ca.skew(leg.crank) @ leg.axis @ joint_row(leg, arm)
    return -tip_row - ca.skew(leg.link / 2) @ link_angular_rows(leg, arm)


def link_jacobian(leg: LegVectors, arm: ca.SX) -> ca.SX:
    """J_b (6, 6): twist of the link's centre of mass (eq. 16)."""
    return ca.vertcat(link_centre_rows(leg, arm), link_angular_rows(leg, arm))
