"""The paper's Jacobians (eq. 7-16 and 29) and their time derivatives (Appendix A), in CasADi.

The paper's Jacobians (eq. 7-16 and 29), in CasADi. All but J_theta map the twist [h_dot, omega] (6,), base axes.
J_a1, J_a2, J_ad: crank angle rates; J_a = [J_au; s J_ad]: crank centre of mass velocity and angular velocity;
J_b = [J_bu; J_bd]: link centre of mass velocity and angular velocity; J_theta: crank angle rates from pose rates.
J_e (eq. 2) is `rotation.euler_rate_jacobian`. Centres of mass lie at mid-length: c_w = w / 2, c_l = l / 2. The vector
a from the platform origin to joint A is in base axes throughout (eq. 3 and 5 need R a, though the text defines a in
platform axes).

Time derivatives of the Jacobians for a given twist, in the closed forms of the paper's Appendix A, in CasADi.
Where a printed form is not the derivative of its Jacobian, the code is right and the comment names the equation. The
tests hold every one of them against automatic derivatives. Base axes; SI units.
"""

from dataclasses import dataclass

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


@dataclass(frozen=True)
class MovingLeg:
    """A leg and the arm a (3,) to its platform joint, with their rates (3,): w_dot = omega_1 x w,
    l_dot = omega_2 x l, a_dot = omega x a."""

    leg: LegVectors
    arm: ca.SX
    crank_rate: ca.SX
    link_rate: ca.SX
    arm_rate: ca.SX


def moving_leg(leg: LegVectors, arm: ca.SX, twist: ca.SX) -> MovingLeg:
    """The leg's vectors as a twist (6,) of the platform moves them."""
    crank_rate = ca.cross(leg.axis, leg.crank) * (joint_row(leg, arm) @ twist)
    link_rate = ca.cross(link_angular_rows(leg, arm) @ twist, leg.link)
    return MovingLeg(leg, arm, crank_rate, link_rate, ca.cross(twist[3:6], arm))


def crank_leverage_rate(moving: MovingLeg) -> ca.SX:
    """Diagonal entry of J_a1_dot, m^2/s: m_dot of eq. A3."""
    leg = moving.leg
    return ca.dot(ca.cross(leg.crank, moving.link_rate) - ca.cross(leg.link, moving.crank_rate), leg.axis)


def link_row_rate(moving: MovingLeg) -> ca.SX:
    """Row of J_a2_dot (1, 6): the second bracket of eq. A2."""
    turned = ca.cross(moving.arm, moving.link_rate) - ca.cross(moving.leg.link, moving.arm_rate)
    return ca.horzcat(moving.link_rate.T, turned.T)


def joint_row_rate(moving: MovingLeg) -> ca.SX:
    """Row of J_ad_dot (1, 6) (eq. A2)."""
    m = crank_leverage(moving.leg)
    return -crank_leverage_rate(moving) / m**2 * link_row(moving.leg, moving.arm) + link_row_rate(moving) / m


def crank_centre_rows_rate(moving: MovingLeg) -> ca.SX:
    """J_au_dot (3, 6) (eq. A3)."""
    leg, arm = moving.leg, moving.arm
    moved = ca.cross(leg.axis, moving.crank_rate / 2) @ joint_row(leg, arm)
    return moved + ca.cross(leg.axis, leg.crank / 2) @ joint_row_rate(moving)


def crank_jacobian_rate(moving: MovingLeg) -> ca.SX:
    """J_a_dot (6, 6) (eq. A1)."""
    return ca.vertcat(crank_centre_rows_rate(moving), moving.leg.axis @ joint_row_rate(moving))


def link_angular_rows_rate(moving: MovingLeg) -> ca.SX:
    """J_bd_dot (3, 6) (eq. A5)."""
    leg, arm = moving.leg, moving.arm
    link, link_rate = ca.skew(leg.link), ca.skew(moving.link_rate)
    # Eq. A5 prints +[l][omega x a]; the derivative of -[l][a] in eq. 13 has a minus there.
    platform = ca.horzcat(link_rate, -link @ ca.skew(moving.arm_rate) - link_rate @ ca.skew(arm))
    # [omega_2 x l][w] s J_ad + [l][omega_1 x w] s J_ad + [l][w] s J_ad_dot
    tip = link_rate @ ca.cross(leg.crank, leg.axis) @ joint_row(leg, arm) + link @ _tip_row_rate(moving)
    return (platform + tip) / ca.dot(leg.link, leg.link)


def link_centre_rows_rate(moving: MovingLeg) -> ca.SX:
    """J_bu_dot (3, 6) (eq. A6)."""
    leg, arm = moving.leg, moving.arm
    # Eq. A6 prints [omega_2 x l] before J_bd; what moves there is the centre of mass c_l = l / 2 of eq. 15.
    centre = ca.skew(moving.link_rate / 2) @ link_angular_rows(leg, arm)
    return -_tip_row_rate(moving) - centre - ca.skew(leg.link / 2) @ link_angular_rows_rate(moving)


def link_jacobian_rate(moving: MovingLeg) -> ca.SX:
    """J_b_dot (6, 6) (eq. A4)."""
    return ca.vertcat(link_centre_rows_rate(moving), link_angular_rows_rate(moving))


def _tip_row_rate(moving: MovingLeg) -> ca.SX:
    """Derivative of [w] s J_ad (3, 6): [omega_1 x w] s J_ad + [w] s J_ad_dot; the negative motion of the crank tip."""
    leg, arm = moving.leg, moving.arm
    moved = ca.cross(moving.crank_rate, leg.axis) @ joint_row(leg, arm)
    return moved + ca.cross(leg.crank, leg.axis) @ joint_row_rate(moving)
