"""The CasADi functions of one robot that `Robot` evaluates."""

import casadi as ca

from dynamics.expressions import function
from dynamics.kinematics.platform import pose_rate_to_twist, twist_bias
from dynamics.legs.rss_geometry import Rss6Geometry
from dynamics.legs.rss_kinematics import (
    joint_angles,
    joint_jacobian,
    loop_closure,
    pose_jacobian,
    reach_margin,
    singularity_measures,
)
from dynamics.parameters import COULOMB, PARAMETER_NAMES, RIGID_BODY, VISCOUS
from dynamics.rigid_body.virtual_work import (
    coriolis_matrix,
    friction_regressor,
    gravity_wrench,
    inertial_wrench,
    mass_matrix,
    rigid_body_regressor,
)

FUNCTION_NAMES = (
    "inverse_kinematics",
    "loop_closure",
    "singularity_measures",
    "joint_jacobian",
    "pose_jacobian",
    "twist",
    "twist_dot",
    "pose_rate",
    "mass_matrix",
    "coriolis_matrix",
    "gravity_wrench",
    "friction_wrench",
    "regressor",
    "inverse_dynamics",
    "forward_dynamics",
)


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
    mass = mass_matrix(geometry, pose, rigid)
    acceleration = _ldl_solve(mass, jacobian.T @ (torque - friction) - bias)
    regressor = ca.horzcat(
        rigid_body_regressor(geometry, pose, twist, twist_dot), friction_regressor(jacobian, velocity)
    )
    return [
        function("mass_matrix", [pose, xi], [mass]),
        function("coriolis_matrix", [pose, twist, xi], [coriolis_matrix(geometry, pose, twist, rigid)]),
        function("gravity_wrench", [pose, xi], [gravity_wrench(geometry, pose, rigid)]),
        function("friction_wrench", [pose, twist, xi], [jacobian.T @ friction]),
        function("regressor", [pose, twist, twist_dot], [regressor]),
        function("inverse_dynamics", [pose, twist, twist_dot, xi], [ca.solve(jacobian.T, inertial) + friction]),
        function("forward_dynamics", [pose, twist, torque, xi], [acceleration]),
    ]


def robot_functions(geometry: Rss6Geometry) -> list[ca.Function]:
    """All that `Robot` evaluates; their names are FUNCTION_NAMES."""
    return kinematic_functions(geometry) + dynamic_functions(geometry)


def _ldl_solve(matrix: ca.SX, right: ca.SX) -> ca.SX:
    diagonal, upper, order = ca.ldl(matrix)
    return ca.ldl_solve(right, diagonal, upper, order)
