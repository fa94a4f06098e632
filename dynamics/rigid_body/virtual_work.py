"""Virtual-work dynamics of the 6-RSS robot (eq. 17-26), in CasADi. Wrenches act at the platform origin, base axes.

Signs: the paper's eq. 20 carries M, C, G of the fictitious forces (negative masses, G = +m g) into eq. 23; here M is
positive definite, G the wrench that holds the robot up, and tau_g = M twist_dot + C twist + G + tau_f as in eq. 17.
"""

import casadi as ca

from dynamics.kinematics.geometry import LEGS, Rss6Geometry
from dynamics.kinematics.inverse_kinematics import LegVectors, leg_vectors, platform_arms
from dynamics.kinematics.jacobians import (
    crank_jacobian,
    crank_jacobian_rate,
    link_jacobian,
    link_jacobian_rate,
    moving_leg,
)
from dynamics.kinematics.rotation import rotation_matrix, symmetric_from_lower
from dynamics.rigid_body.leg_dynamics import leg_columns, leg_force, leg_mass, leg_motion, link_axes


def rigid_body_regressor(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX) -> ca.SX:
    """Columns of Gamma (6, 52) for the inertial parameters of platform, cranks and links (eq. 25)."""
    gravity = ca.DM(geometry.gravity)
    cranks, links = [], []
    for leg, arm in zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), strict=True):
        forces = leg_columns(leg, leg_motion(leg, *joint_motion(arm, twist, twist_dot)), gravity)
        wrenches = ca.vertcat(forces, ca.skew(arm) @ forces)
        cranks.append(wrenches[:, 0:4])
        links.append(wrenches[:, 4:8])
    return ca.horzcat(platform_columns(pose, twist, twist_dot, gravity), *cranks, *links)


def platform_columns(pose: ca.SX, twist: ca.SX, twist_dot: ca.SX, gravity: ca.DM) -> ca.SX:
    """Wrench (6, 4) of the platform alone for unit mass, Ixx, Iyy, Izz about its own axes."""
    frame, omega, omega_dot = rotation_matrix(pose[3:6]), twist[3:6], twist_dot[3:6]
    moments = []
    for axis in range(3):
        direction = frame[:, axis]
        gyroscopic = ca.cross(omega, direction) * ca.dot(direction, omega)
        moments.append(direction * ca.dot(direction, omega_dot) + gyroscopic)
    mass = ca.vertcat(twist_dot[0:3] - gravity, ca.SX.zeros(3))
    return ca.horzcat(mass, ca.vertcat(ca.SX.zeros(3, 3), ca.horzcat(*moments)))


def friction_regressor(joint_jacobian: ca.SX, joint_velocity: ca.SX) -> ca.SX:
    """Columns of Gamma (6, 12) for Coulomb, then viscous friction (eq. 24 without its stray second v_E)."""
    return ca.horzcat(joint_jacobian.T @ ca.diag(ca.sign(joint_velocity)), joint_jacobian.T @ ca.diag(joint_velocity))


def inertial_wrench(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX, rigid: ca.SX) -> ca.SX:
    """M twist_dot + C twist + G (6,) for the 52 inertial parameters `rigid`: the regressor times them, without it."""
    gravity = ca.DM(geometry.gravity)
    total = platform_columns(pose, twist, twist_dot, gravity) @ rigid[0:4]
    for index, (leg, arm) in enumerate(zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), strict=True)):
        motion = leg_motion(leg, *joint_motion(arm, twist, twist_dot))
        force = leg_force(leg, motion, crank_parameters(rigid, index), link_parameters(rigid, index), gravity)
        total += ca.vertcat(force, ca.cross(arm, force))
    return total


def joint_motion(arm: ca.SX, twist: ca.SX, twist_dot: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Velocity and acceleration (3,) of a platform joint at `arm` (3,) from the platform origin."""
    omega, omega_dot = twist[3:6], twist_dot[3:6]
    velocity = twist[0:3] + ca.cross(omega, arm)
    return velocity, twist_dot[0:3] + ca.cross(omega_dot, arm) + ca.cross(omega, ca.cross(omega, arm))


def mass_matrix(geometry: Rss6Geometry, pose: ca.SX, rigid: ca.SX) -> ca.SX:
    """M (6, 6) of eq. 23, symmetric positive definite for positive parameters."""
    total = _body_mass(rotation_matrix(pose[3:6]), rigid[0:4])
    for index, (leg, arm) in enumerate(zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), strict=True)):
        at_joint = leg_mass(leg, crank_parameters(rigid, index), link_parameters(rigid, index))
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        total += to_joint.T @ at_joint @ to_joint
    return symmetric_from_lower(total)


def coriolis_matrix(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, rigid: ca.SX) -> ca.SX:
    """C (6, 6) of eq. 23: C twist is the Coriolis and centrifugal wrench. Jacobian rates in closed form (eq. A1-A6)."""
    total = _body_coriolis(rotation_matrix(pose[3:6]), rigid[0:4], twist[3:6])
    for index, (leg, arm) in enumerate(zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), strict=True)):
        moving = moving_leg(leg, arm, twist)
        for jacobian, rate, frame, parameters in (
            (crank_jacobian(leg, arm), crank_jacobian_rate(moving), _crank_frame(leg), crank_parameters(rigid, index)),
            (link_jacobian(leg, arm), link_jacobian_rate(moving), _link_frame(leg), link_parameters(rigid, index)),
        ):
            coriolis = _body_coriolis(frame, parameters, jacobian[3:6, :] @ twist)
            total += jacobian.T @ (coriolis @ jacobian + _body_mass(frame, parameters) @ rate)
    return total


def gravity_wrench(geometry: Rss6Geometry, pose: ca.SX, rigid: ca.SX) -> ca.SX:
    """G (6,) of eq. 23, N and N m: the wrench that holds the robot against gravity."""
    gravity = ca.DM(geometry.gravity)
    total = ca.vertcat(-rigid[0] * gravity, ca.SX.zeros(3))
    for index, (leg, arm) in enumerate(zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), strict=True)):
        total -= crank_parameters(rigid, index)[0] * crank_jacobian(leg, arm)[0:3, :].T @ gravity
        total -= link_parameters(rigid, index)[0] * link_jacobian(leg, arm)[0:3, :].T @ gravity
    return total


def crank_parameters(rigid: ca.SX, index: int) -> ca.SX:
    """Mass, Ixx, Iyy, Izz (4,) of one crank, index 0..5."""
    return rigid[4 + 4 * index : 8 + 4 * index]


def link_parameters(rigid: ca.SX, index: int) -> ca.SX:
    """Mass, Ixx, Iyy, Izz (4,) of one link, index 0..5."""
    return crank_parameters(rigid, LEGS + index)


def _crank_frame(leg: LegVectors) -> ca.SX:
    """Base-from-crank rotation (3, 3): x from B to T, z along the joint axis."""
    x = leg.crank / ca.norm_2(leg.crank)
    return ca.horzcat(x, ca.cross(leg.axis, x), leg.axis)


def _link_frame(leg: LegVectors) -> ca.SX:
    return ca.horzcat(*link_axes(leg), leg.link / ca.norm_2(leg.link))


def _body_mass(frame: ca.SX, parameters: ca.SX) -> ca.SX:
    return ca.diagcat(parameters[0] * ca.SX.eye(3), frame @ ca.diag(parameters[1:4]) @ frame.T)


def _body_coriolis(frame: ca.SX, parameters: ca.SX, omega: ca.SX) -> ca.SX:
    return ca.diagcat(ca.SX.zeros(3, 3), ca.skew(omega) @ frame @ ca.diag(parameters[1:4]) @ frame.T)
