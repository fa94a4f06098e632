"""Equation of motion in the platform's coordinates and its derivatives, as the closed-loop integrator evaluates them
(CasADi).

With q the coordinates (the pose, or what of it the chart leaves free), the wrench balance is premultiplied by T^T
(twist = T q_dot, eq. 29):

    M(q) q_ddot + b(q, q_dot) = J_theta^T (torque - friction)

Legs enter through the motion of their platform joints A only, so derivatives are formed leg by leg with respect to
three vectors of length 3 and chained through dA/dq.
"""

import casadi as ca
import numpy as np

from dynamics.expressions import function, symmetric_from_lower
from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import PlatformJointMotion, pose_rate_to_twist, twist_bias
from dynamics.parameters import parameter_layout
from dynamics.rigid_body.jacobians import freedoms
from dynamics.rigid_body.virtual_work import platform_columns, platform_mass


def motion_functions(geometry: AnyGeometry) -> list[ca.Function]:
    """What the closed loop integrates."""
    return [equation_of_motion(geometry), motion_derivatives(geometry), rate_map_derivative(geometry)]


def equation_of_motion(geometry: AnyGeometry) -> ca.Function:
    """(q, rate (m,), rigid (p,)) -> M (m, m), b (m,), J_theta (n, m), J_theta_dot rate (n,), theta (n,)."""
    layout, (q, rate) = parameter_layout(geometry.legs), _coordinates(geometry, "q", "rate")
    (pose, pose_rate, rest), free = _poses(geometry, q, rate, 0 * rate), freedoms(geometry)
    rigid = ca.SX.sym("rigid", layout.rigid.stop)
    joints = _joints(geometry)
    to_twist = pose_rate_to_twist(joints.pose)
    mass = to_twist.T @ platform_mass(joints.pose, rigid[0:4]) @ to_twist
    bias = _platform_columns(geometry, joints) @ rigid[0:4]
    rows, accelerations, coordinates = [], [], []
    for number, leg in enumerate(geometry.legs):
        own, motion = rigid[layout.leg_rows(number)], joints.of(number)
        gradient = joints.gradient[number]
        mass += gradient.T @ leg.mass(motion[0], own) @ gradient
        bias += gradient.T @ leg.force(*motion, own, ca.DM(geometry.gravity))
        rows.append(leg.gradient(motion[0]).T @ gradient)
        accelerations.append(leg.acceleration(*motion))
        coordinates.append(leg.coordinate(motion[0]))
    outputs = [
        symmetric_from_lower(free.T @ symmetric_from_lower(mass) @ free),
        free.T @ bias,
        ca.vertcat(*rows) @ free,
        ca.vertcat(*accelerations),
        ca.vertcat(*coordinates),
    ]
    return function(
        "equation_of_motion", [q, rate, rigid, *geometry.symbols], _at(joints, outputs, pose, pose_rate, rest)
    )


def motion_derivatives(geometry: AnyGeometry) -> ca.Function:
    """(q, rate, acceleration (m,), torque (n,), rigid (p,)) -> derivatives at fixed acceleration and net joint torque.

    Of the residual M q_ddot + b - J_theta^T torque: with respect to q (m, m), rate (m, m) and rigid (m, p). Of the
    joint accelerations: with respect to q (n, m) and rate (n, m); the latter is 2 J_theta_dot.
    The linear solve for q_ddot is left to the caller and never differentiated.
    """
    layout, (q, rate, acceleration) = parameter_layout(geometry.legs), _coordinates(geometry, "q", "rate", "gain")
    motion, free = _poses(geometry, q, rate, acceleration), freedoms(geometry)
    torque, rigid = ca.SX.sym("torque", layout.joints), ca.SX.sym("rigid", layout.rigid.stop)
    joints = _joints(geometry)
    platform = _platform_columns(geometry, joints)
    by_pose = ca.jacobian(platform @ rigid[0:4], joints.pose)
    by_rate = ca.jacobian(platform @ rigid[0:4], joints.rate)
    columns = ca.SX.zeros(6, layout.rigid.stop)
    columns[:, 0:4] = platform
    joint_by_pose, joint_by_rate = [], []
    for number in range(layout.joints):
        own = rigid[layout.leg_rows(number)]
        local, net_force, force, joint = _leg_derivatives(geometry, number, joints, torque[number], own)
        gradient = joints.gradient[number]
        by_pose += gradient.T @ _by_pose(force, joints, number) + joints.curvature(number, net_force)
        by_rate += gradient.T @ _by_rate(force, joints, number)
        joint_by_pose.append(_by_pose(joint, joints, number))
        joint_by_rate.append(_by_rate(joint, joints, number))
        columns[:, layout.leg_rows(number)] = gradient.T @ local
    outputs = [
        free.T @ by_pose @ free,
        free.T @ by_rate @ free,
        free.T @ columns,
        ca.vertcat(*joint_by_pose) @ free,
        ca.vertcat(*joint_by_rate) @ free,
    ]
    return function(
        "motion_derivatives", [q, rate, acceleration, torque, rigid, *geometry.symbols], _at(joints, outputs, *motion)
    )


def rate_map_derivative(geometry: AnyGeometry) -> ca.Function:
    """(q, g) -> d(J_theta g)/dq (n, m) for a constant rate g (m,)."""
    q, rate = _coordinates(geometry, "q", "rate")
    motion, joints, rows = _poses(geometry, q, rate, 0 * rate), _joints(geometry), []
    for number, leg in enumerate(geometry.legs):
        position = ca.SX.sym("position", 3)
        gradient = leg.gradient(position)
        curvature = ca.substitute(ca.jacobian(gradient, position), position, joints.position[number])
        at_joint = ca.substitute(gradient, position, joints.position[number])
        along = joints.velocity[number].T @ curvature @ joints.gradient[number]
        rows.append(at_joint.T @ joints.gradient_rate[number] + along)
    outputs = [ca.vertcat(*rows) @ freedoms(geometry)]
    return function("rate_map_derivative", [q, rate, *geometry.symbols], _at(joints, outputs, *motion))


def _coordinates(geometry: AnyGeometry, *names: str) -> list[ca.SX]:
    return [ca.SX.sym(name, len(geometry.chart.freedoms)) for name in names]


def _poses(geometry: AnyGeometry, q: ca.SX, rate: ca.SX, acceleration: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Pose (6,), its rate and its acceleration of coordinates (m,) and theirs."""
    free = freedoms(geometry)
    at_home = ca.SX(ca.DM(geometry.chart.pose(np.zeros(free.shape[1]))))
    return at_home + free @ q, ca.densify(free @ rate), ca.densify(free @ acceleration)


def _joints(geometry: AnyGeometry) -> PlatformJointMotion:
    return PlatformJointMotion(geometry.platform_joints, *[ca.SX.sym(name, 6) for name in ("pose", "rate", "gain")])


def _at(joints: PlatformJointMotion, outputs: list[ca.SX], *motion: ca.SX) -> list[ca.SX]:
    """Expressions in pose, rate and acceleration of the platform at others."""
    return ca.substitute(outputs, [joints.pose, joints.rate, joints.gain], list(motion))


def _leg_derivatives(
    geometry: AnyGeometry, number: int, joints: PlatformJointMotion, torque: ca.SX, own: ca.SX
) -> tuple[ca.SX, ca.SX, list[ca.SX], list[ca.SX]]:
    """Columns (3, p) of the leg's own parameters, net force (3,), and derivatives of that force and of theta_ddot with
    respect to position, velocity and acceleration of A."""
    leg = geometry.legs[number]
    position, velocity, acceleration = (ca.SX.sym(name, 3) for name in ("position", "velocity", "acceleration"))
    moving = leg.force(position, velocity, acceleration, own, ca.DM(geometry.gravity))
    unit = ca.SX.sym("parameters", own.numel())
    columns = ca.jacobian(leg.force(position, velocity, acceleration, unit, ca.DM(geometry.gravity)), unit)
    force = moving - leg.gradient(position) * torque
    by_acceleration = leg.mass(position, own)
    joint = leg.acceleration(position, velocity, acceleration)
    expressions = [
        columns,
        force,
        ca.jacobian(force, position),
        ca.jacobian(force, velocity),
        by_acceleration,
        ca.jacobian(joint, position),
        ca.jacobian(joint, velocity),
        leg.gradient(position).T,
    ]
    inputs = [position, velocity, acceleration]
    columns, force, *rows = ca.substitute(ca.cse(expressions), inputs, list(joints.of(number)))
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


def _platform_columns(geometry: AnyGeometry, joints: PlatformJointMotion) -> ca.SX:
    to_twist = pose_rate_to_twist(joints.pose)
    twist_dot = to_twist @ joints.gain + twist_bias(joints.pose, joints.rate)
    return to_twist.T @ platform_columns(joints.pose, to_twist @ joints.rate, twist_dot, ca.DM(geometry.gravity))
