"""Closed-form inverse kinematics of RSS legs (eq. 3 and 4), their Jacobians (eq. 7, 8, 29) and singularities (CasADi).

J_a1 and J_a2 (eq. 7): diag(J_a1) theta_dot = J_a2 twist; J_ad = J_a1^-1 J_a2 (eq. 8); J_theta = J_ad T maps pose rates
(eq. 29). The vector a from the platform origin to joint A is in base axes throughout (eq. 3 and 5 need R a, though the
text defines a in platform axes).
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from dynamics.errors import RobotFileError
from dynamics.kinematics.platform import pose_rate_to_twist, rotation_matrix
from dynamics.legs.rss_geometry import LEGS, Rss6Geometry


@dataclass(frozen=True)
class LegVectors:
    """One leg, base axes, m: crank angle (rad), axis s, crank w = T - B and link l = A - T, each (3,), and their
    lengths, which are constants of the robot."""

    angle: ca.SX
    axis: ca.SX
    crank: ca.SX
    link: ca.SX
    crank_length: float
    link_length: float


def platform_arms(geometry: Rss6Geometry, pose: ca.SX) -> list[ca.SX]:
    """Vectors a from the platform origin to its six joints (3,), base axes, m."""
    rotation = rotation_matrix(pose[3:6])
    return [rotation @ geometry.platform_joints[leg] for leg in range(LEGS)]


def legs_at(geometry: Rss6Geometry, pose: ca.SX) -> list[tuple[LegVectors, ca.SX]]:
    """The six legs at a pose (6,), and the vectors a to their joints. Entries of a leg that cannot reach are NaN."""
    arms = platform_arms(geometry, pose)
    return [(leg_to(geometry, leg, pose[0:3] + arm), arm) for leg, arm in enumerate(arms)]


def leg_to(geometry: Rss6Geometry, leg: int, joint_position: ca.SX) -> LegVectors:
    """One leg with its platform joint A at joint_position (3,).

    Solves along cos(theta) + across sin(theta) = chord on the branch that passes through theta = 0 at home.
    """
    zero, axis = geometry.crank_zero_directions[leg], geometry.crank_axes[leg]
    along, across, chord = _chord(geometry, leg, joint_position)
    square = along**2 + across**2
    root = home_branch(geometry, leg) * ca.sqrt(square - chord**2)
    inverse = 1 / square
    cosine = (along * chord - across * root) * inverse
    sine = (across * chord + along * root) * inverse
    crank = geometry.crank_length * (cosine * zero + sine * np.cross(axis, zero))
    link = joint_position - geometry.base_joints[leg] - crank
    return LegVectors(ca.atan2(sine, cosine), ca.SX(axis), crank, link, geometry.crank_length, geometry.link_length)


def joint_angles(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """Crank angles (6,), rad, at a pose (6,)."""
    return ca.vertcat(*[leg.angle for leg, _ in legs_at(geometry, pose)])


def crank_leverage(leg: LegVectors) -> ca.SX:
    """Diagonal entry of J_a1, m^2: (w x l) . s (eq. 7). Zero where the leg is singular."""
    return ca.dot(ca.cross(leg.crank, leg.link), leg.axis)


def angle_gradient(leg: LegVectors) -> ca.SX:
    """l / J_a1 (3,), 1/m: gradient of the crank angle with respect to A, and force at A of a unit torque (eq. 8)."""
    return leg.link * (1 / crank_leverage(leg))


def loop_jacobians(geometry: Rss6Geometry, pose: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Diagonal of J_a1 (6,), m^2, and J_a2 (6, 6), rows [l^T, (a x l)^T], m and m^2 (eq. 7)."""
    legs = legs_at(geometry, pose)
    rows = [ca.horzcat(leg.link.T, ca.cross(arm, leg.link).T) for leg, arm in legs]
    return ca.vertcat(*[crank_leverage(leg) for leg, _ in legs]), ca.vertcat(*rows)


def joint_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_ad (6, 6): theta_dot = J_ad twist (eq. 8)."""
    leverage, rows = loop_jacobians(geometry, pose)
    return ca.vertcat(*[rows[leg, :] / leverage[leg] for leg in range(LEGS)])


def pose_jacobian(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """J_theta (6, 6): theta_dot = J_theta pose_dot (eq. 29)."""
    return joint_jacobian(geometry, pose) @ pose_rate_to_twist(pose)


def singularity_measures(geometry: Rss6Geometry, pose: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Leverage of each crank on its link, |J_a1| / (|w| |l|) (6,), in 0..1; and J_a2 (6, 6) without unit, its rows
    over the link length and its last three columns over the characteristic length."""
    leverage, rows = loop_jacobians(geometry, pose)
    scale = np.repeat([1.0, geometry.characteristic_length], 3) * geometry.link_length
    return ca.fabs(leverage) / (geometry.crank_length * geometry.link_length), rows @ ca.diag(1 / scale)


def loop_closure(geometry: Rss6Geometry, pose: ca.SX, angles: ca.SX) -> tuple[ca.SX, ca.SX]:
    """How far the loops of eq. 3 and 4 are from closed at a pose and crank angles chosen freely, and its derivative.

    Gaps (|A - T|^2 - link_length^2) / 2 (6,) in m^2, and d(gaps)/d(pose) (6, 6): J_a2 times the matrix of eq. 29.
    """
    gaps = []
    for leg, arm in enumerate(platform_arms(geometry, pose)):
        zero, axis = geometry.crank_zero_directions[leg], geometry.crank_axes[leg]
        crank = geometry.crank_length * (ca.cos(angles[leg]) * zero + ca.sin(angles[leg]) * np.cross(axis, zero))
        link = pose[0:3] + arm - geometry.base_joints[leg] - crank
        gaps.append((ca.dot(link, link) - geometry.link_length**2) / 2)
    gap = ca.vertcat(*gaps)
    return gap, ca.jacobian(gap, pose)


def reach_margin(geometry: Rss6Geometry, pose: ca.SX) -> ca.SX:
    """sin^2 of the angle between crank and reach direction (6,), dimensionless; negative: out of reach."""
    rows = []
    for leg, arm in enumerate(platform_arms(geometry, pose)):
        along, across, chord = _chord(geometry, leg, pose[0:3] + arm)
        rows.append(1 - chord**2 / (along**2 + across**2))
    return ca.vertcat(*rows)


def home_branch(geometry: Rss6Geometry, leg: int) -> float:
    """+1 or -1: which of the two crank solutions is the one assembled at home (theta nearest to zero there)."""
    along, across, chord = _home_chord(geometry, leg)
    root = np.sqrt(max(along**2 + across**2 - chord**2, 0.0))
    angles = {
        sign: abs(np.arctan2(across * chord + sign * along * root, along * chord - sign * across * root))
        for sign in (1.0, -1.0)
    }
    return min(angles, key=angles.__getitem__)


def home_angles(geometry: Rss6Geometry) -> np.ndarray:
    """Crank angles (6,), rad, at the home pose. Raises RobotFileError, naming the leg, where that is out of reach."""
    for leg in range(LEGS):
        along, across, chord = _home_chord(geometry, leg)
        if not chord**2 < along**2 + across**2:
            raise RobotFileError(
                f"leg {leg + 1} cannot reach the home pose: reach margin "
                f"{1 - chord**2 / max(along**2 + across**2, 1e-300):.3g}, must be > 0"
            )
    return np.array([float(leg.angle) for leg, _ in legs_at(geometry, ca.SX(geometry.home_pose))])


def _home_chord(geometry: Rss6Geometry, leg: int) -> tuple[float, float, float]:
    home = ca.SX(geometry.home_pose)
    joint = home[0:3] + rotation_matrix(home[3:6]) @ geometry.platform_joints[leg]
    along, across, chord = (float(value) for value in _chord(geometry, leg, joint))
    return along, across, chord


def _chord(geometry: Rss6Geometry, leg: int, joint_position: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Components of B->A along and across the crank's zero direction, and the component the link length asks for."""
    reach = joint_position - geometry.base_joints[leg]
    zero = geometry.crank_zero_directions[leg]
    across = np.cross(geometry.crank_axes[leg], zero)
    radius, length = geometry.crank_length, geometry.link_length
    chord = (ca.dot(reach, reach) + radius**2 - length**2) / (2 * radius)
    return ca.dot(reach, zero), ca.dot(reach, across), chord
