"""Virtual-work dynamics (eq. 17-26), in CasADi: sums over platform and legs, and the functions that `Robot` evaluates.

Wrenches act at the platform origin, base axes.

Signs: the paper's eq. 20 carries M, C, G of the fictitious forces (negative masses, G = +m g) into eq. 23; here M is
positive definite, G the wrench that holds the robot up, and tau_g = M twist_dot + C twist + G + tau_f as in eq. 17.
"""

import casadi as ca

from dynamics.expressions import function, symmetric_from_lower
from dynamics.kinematics.platform import joint_motion, pose_rate_to_twist, rotation_matrix, twist_bias
from dynamics.legs.rss_dynamics import leg_columns, leg_coriolis, leg_force, leg_mass, leg_motion
from dynamics.legs.rss_geometry import LEGS, Rss6Geometry
from dynamics.legs.rss_inverse_kinematics import (
    joint_angles,
    joint_jacobian,
    leg_to,
    legs_at,
    loop_closure,
    platform_arms,
    pose_jacobian,
    reach_margin,
    singularity_measures,
)
from dynamics.parameters import COULOMB, PARAMETER_NAMES, RIGID_BODY, VISCOUS


def rigid_body_regressor(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX) -> ca.SX:
    """Columns of Gamma (6, 52) for the inertial parameters of platform, cranks and links (eq. 25)."""
    gravity = ca.DM(geometry.gravity)
    cranks, links = [], []
    for leg, arm in legs_at(geometry, pose):
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


def inertial_wrench(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX, rigid: ca.SX) -> ca.SX:
    """M twist_dot + C twist + G (6,) for the 52 inertial parameters `rigid`: the regressor times them, without it."""
    gravity = ca.DM(geometry.gravity)
    total = platform_columns(pose, twist, twist_dot, gravity) @ rigid[0:4]
    for index, (leg, arm) in enumerate(legs_at(geometry, pose)):
        motion = leg_motion(leg, *joint_motion(arm, twist, twist_dot))
        force = leg_force(leg, motion, *leg_parameters(rigid, index), gravity)
        total += ca.vertcat(force, ca.cross(arm, force))
    return total


def mass_matrix(geometry: Rss6Geometry, pose: ca.SX, rigid: ca.SX) -> ca.SX:
    """M (6, 6) of eq. 23, symmetric positive definite for positive parameters."""
    total = platform_mass(pose, rigid[0:4])
    for index, (leg, arm) in enumerate(legs_at(geometry, pose)):
        at_joint = leg_mass(leg, *leg_parameters(rigid, index))
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        total += to_joint.T @ at_joint @ to_joint
    return symmetric_from_lower(total)


def coriolis_matrix(geometry: Rss6Geometry, pose: ca.SX, twist: ca.SX, rigid: ca.SX) -> ca.SX:
    """C (6, 6) of eq. 23: C twist is the Coriolis and centrifugal wrench."""
    frame, omega = rotation_matrix(pose[3:6]), twist[3:6]
    total = ca.diagcat(ca.SX.zeros(3, 3), ca.skew(omega) @ frame @ ca.diag(rigid[1:4]) @ frame.T)
    at, moving = ca.SX.sym("position", 3), ca.SX.sym("velocity", 3)
    for index, arm in enumerate(platform_arms(geometry, pose)):
        own = leg_parameters(rigid, index)
        here = [pose[0:3] + arm, twist[0:3] + ca.cross(omega, arm)]
        coriolis, mass = ca.substitute(
            ca.cse([*leg_coriolis(leg_to(geometry, index, at), *own, at, moving)]), [at, moving], here
        )
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        to_joint_rate = ca.horzcat(ca.SX.zeros(3, 3), -ca.skew(ca.cross(omega, arm)))
        total += to_joint.T @ (coriolis @ to_joint + mass @ to_joint_rate)
    return total


def platform_mass(pose: ca.SX, platform: ca.SX) -> ca.SX:
    """Mass matrix (6, 6) of the platform alone for its mass, Ixx, Iyy, Izz (4,)."""
    frame = rotation_matrix(pose[3:6])
    return ca.diagcat(platform[0] * ca.SX.eye(3), frame @ ca.diag(platform[1:4]) @ frame.T)


def leg_parameters(rigid: ca.SX, leg: int) -> tuple[ca.SX, ca.SX]:
    """Mass, Ixx, Iyy, Izz (4,) of crank and link of a leg, 0..5, from the 52 inertial parameters."""
    crank, link = 4 + 4 * leg, 4 + 4 * (LEGS + leg)
    return rigid[crank : crank + 4], rigid[link : link + 4]


def kinematic_functions(geometry: Rss6Geometry) -> list[ca.Function]:
    """Functions of pose and its rates alone: angles, reach, Jacobians, twist conversions."""
    pose, rate, acceleration = ca.SX.sym("pose", 6), ca.SX.sym("pose_rate", 6), ca.SX.sym("pose_acceleration", 6)
    twist, theta = ca.SX.sym("twist", 6), ca.SX.sym("theta", 6)
    to_twist = pose_rate_to_twist(pose)
    return [
        function("inverse_kinematics", [pose], [joint_angles(geometry, pose), reach_margin(geometry, pose)]),
        function("loop_closure", [pose, theta], list(loop_closure(geometry, pose, theta))),
        function("singularity_measures", [pose], list(singularity_measures(geometry, pose))),
        function("joint_jacobian", [pose], [joint_jacobian(geometry, pose)]),
        function("pose_jacobian", [pose], [pose_jacobian(geometry, pose)]),
        function("twist", [pose, rate], [to_twist @ rate]),
        function("twist_dot", [pose, rate, acceleration], [to_twist @ acceleration + twist_bias(pose, rate)]),
        function("pose_rate", [pose, twist], [ca.solve(to_twist, twist)]),
    ]


def dynamic_functions(geometry: Rss6Geometry) -> list[ca.Function]:
    """M, C, G, friction, regressor (eq. 23-26), inverse dynamics (eq. 17) and forward dynamics (eq. 40)."""
    pose, twist, twist_dot = ca.SX.sym("pose", 6), ca.SX.sym("twist", 6), ca.SX.sym("twist_dot", 6)
    torque, xi = ca.SX.sym("torque", 6), ca.SX.sym("parameters", len(PARAMETER_NAMES))
    rigid = xi[RIGID_BODY]
    jacobian = joint_jacobian(geometry, pose)
    velocity = jacobian @ twist
    friction = xi[COULOMB] * ca.sign(velocity) + xi[VISCOUS] * velocity
    inertial = inertial_wrench(geometry, pose, twist, twist_dot, rigid)
    bias = inertial_wrench(geometry, pose, twist, ca.SX.zeros(6), rigid)
    holding = inertial_wrench(geometry, pose, ca.SX(6, 1), ca.SX(6, 1), rigid)
    mass = mass_matrix(geometry, pose, rigid)
    diagonal, upper, order = ca.ldl(mass)
    acceleration = ca.ldl_solve(jacobian.T @ (torque - friction) - bias, diagonal, upper, order)
    # Coulomb, then viscous friction: eq. 24 without its stray second v_E.
    rubbing = [jacobian.T @ ca.diag(ca.sign(velocity)), jacobian.T @ ca.diag(velocity)]
    regressor = ca.horzcat(rigid_body_regressor(geometry, pose, twist, twist_dot), *rubbing)
    return [
        function("mass_matrix", [pose, xi], [mass]),
        function("coriolis_matrix", [pose, twist, xi], [coriolis_matrix(geometry, pose, twist, rigid)]),
        function("gravity_wrench", [pose, xi], [holding]),
        function("friction_wrench", [pose, twist, xi], [jacobian.T @ friction]),
        function("regressor", [pose, twist, twist_dot], [regressor]),
        function("inverse_dynamics", [pose, twist, twist_dot, xi], [ca.solve(jacobian.T, inertial) + friction]),
        function("forward_dynamics", [pose, twist, torque, xi], [acceleration]),
    ]


def robot_functions(geometry: Rss6Geometry) -> list[ca.Function]:
    """All that `Robot` evaluates."""
    return kinematic_functions(geometry) + dynamic_functions(geometry)
