"""Time derivatives of the Jacobians for a given twist, in the closed forms of the paper's Appendix A, in CasADi.

Where a printed form is not the derivative of its Jacobian, the code is right and the comment names the equation. The
tests hold every one of them against automatic derivatives. Base axes; SI units.
"""

from dataclasses import dataclass

import casadi as ca

from dynamics.kinematics.inverse_kinematics import LegVectors
from dynamics.kinematics.jacobians import crank_leverage, joint_row, link_angular_rows, link_row


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
