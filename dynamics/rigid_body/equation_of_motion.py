"""Equation of motion in pose coordinates and its derivatives, as the closed-loop integrator evaluates them (CasADi).

With q the pose, the wrench balance is premultiplied by T^T (twist = T q_dot, eq. 29):

    M(q) q_ddot + b(q, q_dot) = J_theta^T (torque - friction)

Legs enter through the motion of their platform joints A only, so derivatives are formed leg by leg with respect to
three vectors of length 3 and chained through dA/dq.
"""

import casadi as ca

from dynamics.expressions import function, symmetric_from_lower
from dynamics.kinematics.platform import PlatformJointMotion, pose_rate_to_twist, twist_bias
from dynamics.legs.rss_dynamics import leg_columns, leg_force, leg_mass, leg_motion
from dynamics.legs.rss_geometry import LEGS, Rss6Geometry
from dynamics.legs.rss_inverse_kinematics import angle_gradient, leg_to
from dynamics.parameters import RIGID_BODY
from dynamics.rigid_body.virtual_work import leg_parameters, platform_columns, platform_mass


def equation_of_motion(geometry: Rss6Geometry) -> ca.Function:
    """(pose, rate, rigid) -> M (6, 6), b (6,), J_theta (6, 6), J_theta_dot rate (6,), theta (6,)."""
    pose, rate, rigid = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6), ca.SX.sym("rigid", RIGID_BODY.stop)
    rest = ca.SX.zeros(6)
    joints = PlatformJointMotion(geometry.platform_joints, pose, rate, rest)
    to_twist = pose_rate_to_twist(pose)
    mass = to_twist.T @ platform_mass(pose, rigid[0:4]) @ to_twist
    bias = _platform_columns(geometry, pose, rate, rest) @ rigid[0:4]
    rows, crank_accelerations, angles = [], [], []
    for leg in range(LEGS):
        vectors = leg_to(geometry, leg, joints.position[leg])
        motion = leg_motion(vectors, joints.velocity[leg], joints.acceleration[leg])
        crank, link = leg_parameters(rigid, leg)
        gradient = joints.gradient[leg]
        mass += gradient.T @ leg_mass(vectors, crank, link) @ gradient
        bias += gradient.T @ leg_force(vectors, motion, crank, link, ca.DM(geometry.gravity))
        rows.append(angle_gradient(vectors).T @ gradient)
        crank_accelerations.append(motion.crank_acceleration)
        angles.append(vectors.angle)
    mass = symmetric_from_lower(mass)
    outputs = [mass, bias, ca.vertcat(*rows), ca.vertcat(*crank_accelerations), ca.vertcat(*angles)]
    return function("equation_of_motion", [pose, rate, rigid], outputs)


def motion_derivatives(geometry: Rss6Geometry) -> ca.Function:
    """(pose, rate, acceleration, torque, rigid) -> derivatives at fixed acceleration and net joint torque.

    Of the residual M q_ddot + b - J_theta^T torque: with respect to pose (6, 6), rate (6, 6) and rigid (6, 52).
    Of the crank accelerations: with respect to pose (6, 6) and rate (6, 6); the latter is 2 J_theta_dot.
    The linear solve for q_ddot is left to the caller and never differentiated.
    """
    pose, rate, acceleration = (ca.SX.sym(name, 6) for name in ("pose", "rate", "acceleration"))
    torque, rigid = ca.SX.sym("torque", 6), ca.SX.sym("rigid", RIGID_BODY.stop)
    joints = PlatformJointMotion(geometry.platform_joints, pose, rate, acceleration)
    platform = _platform_columns(geometry, pose, rate, acceleration)
    by_pose = ca.jacobian(platform @ rigid[0:4], pose)
    by_rate = ca.jacobian(platform @ rigid[0:4], rate)
    cranks, links, crank_by_pose, crank_by_rate = [], [], [], []
    for leg in range(LEGS):
        local, net_force, force, crank = _leg_derivatives(geometry, leg, joints, torque[leg], rigid)
        gradient = joints.gradient[leg]
        by_pose += gradient.T @ _by_pose(force, joints, leg) + joints.curvature(leg, net_force)
        by_rate += gradient.T @ _by_rate(force, joints, leg)
        crank_by_pose.append(_by_pose(crank, joints, leg))
        crank_by_rate.append(_by_rate(crank, joints, leg))
        cranks.append(gradient.T @ local[:, 0:4])
        links.append(gradient.T @ local[:, 4:8])
    columns = ca.horzcat(platform, *cranks, *links)
    outputs = [by_pose, by_rate, columns, ca.vertcat(*crank_by_pose), ca.vertcat(*crank_by_rate)]
    return function("motion_derivatives", [pose, rate, acceleration, torque, rigid], outputs)


def _leg_derivatives(
    geometry: Rss6Geometry, leg: int, joints: PlatformJointMotion, torque: ca.SX, rigid: ca.SX
) -> tuple[ca.SX, ca.SX, list[ca.SX], list[ca.SX]]:
    """Columns (3, 8), net force (3,), and derivatives of that force and of theta_ddot with respect to position,
    velocity and acceleration of A."""
    inputs = [ca.SX.sym(name, 3) for name in ("position", "velocity", "acceleration")]
    vectors = leg_to(geometry, leg, inputs[0])
    motion = leg_motion(vectors, inputs[1], inputs[2])
    columns = leg_columns(vectors, motion, ca.DM(geometry.gravity))
    own = leg_parameters(rigid, leg)
    moving = leg_force(vectors, motion, *own, ca.DM(geometry.gravity))
    force = moving - angle_gradient(vectors) * torque
    by_acceleration = leg_mass(vectors, *own)
    crank = motion.crank_acceleration
    expressions = [
        columns,
        force,
        ca.jacobian(force, inputs[0]),
        ca.jacobian(force, inputs[1]),
        by_acceleration,
        ca.jacobian(crank, inputs[0]),
        ca.jacobian(crank, inputs[1]),
        angle_gradient(vectors).T,
    ]
    values = [joints.position[leg], joints.velocity[leg], joints.acceleration[leg]]
    columns, force, *rows = ca.substitute(ca.cse(expressions), inputs, values)
    return columns, force, rows[:3], rows[3:]


def _by_pose(rows: list[ca.SX], joints: PlatformJointMotion, leg: int) -> ca.SX:
    by_position, by_velocity, by_acceleration = rows
    return (
        by_position @ joints.gradient[leg]
        + by_velocity @ joints.gradient_rate[leg]
        + by_acceleration @ joints.acceleration_by_pose[leg]
    )


def _by_rate(rows: list[ca.SX], joints: PlatformJointMotion, leg: int) -> ca.SX:
    _, by_velocity, by_acceleration = rows
    return by_velocity @ joints.gradient[leg] + 2 * by_acceleration @ joints.gradient_rate[leg]


def rate_map_derivative(geometry: Rss6Geometry) -> ca.Function:
    """(pose, g) -> d(J_theta g)/d(pose) (6, 6) for a constant pose rate g (6,)."""
    pose, rate = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6)
    joints = PlatformJointMotion(geometry.platform_joints, pose, rate, ca.SX.zeros(6))
    rows = []
    for leg in range(LEGS):
        position = ca.SX.sym("position", 3)
        gradient = angle_gradient(leg_to(geometry, leg, position))
        curvature = ca.substitute(ca.jacobian(gradient, position), position, joints.position[leg])
        at_joint = ca.substitute(gradient, position, joints.position[leg])
        along = joints.velocity[leg].T @ curvature @ joints.gradient[leg]
        rows.append(at_joint.T @ joints.gradient_rate[leg] + along)
    return function("rate_map_derivative", [pose, rate], [ca.vertcat(*rows)])


def _platform_columns(geometry: Rss6Geometry, pose: ca.SX, rate: ca.SX, acceleration: ca.SX) -> ca.SX:
    to_twist = pose_rate_to_twist(pose)
    twist_dot = to_twist @ acceleration + twist_bias(pose, rate)
    return to_twist.T @ platform_columns(pose, to_twist @ rate, twist_dot, ca.DM(geometry.gravity))


def motion_functions(geometry: Rss6Geometry) -> list[ca.Function]:
    """What the closed loop integrates."""
    return [equation_of_motion(geometry), motion_derivatives(geometry), rate_map_derivative(geometry)]
