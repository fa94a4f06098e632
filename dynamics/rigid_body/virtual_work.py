"""Virtual-work dynamics (eq. 17-26) in CasADi, as sums over platform and legs.

`Robot` evaluates these functions. Wrenches act at the platform origin, in the axes of the base.

In eq. 20 and 23 of the paper, M, C and G belong to the fictitious forces, with negative masses and
G = +m g. Here M is positive definite, G is the wrench that balances gravity, and tau_g = M
twist_dot + C twist + G + tau_f as in eq. 17.
"""

import casadi as ca

from dynamics.expressions import function, symmetric_from_lower
from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import (
    joint_motion,
    pose_rate_to_twist,
    rotation_matrix,
    twist_bias,
)
from dynamics.rigid_body.jacobians import (
    joint_coordinates,
    joint_jacobian,
    loop_closure,
    placements,
    platform_arms,
    pose_basis,
    pose_jacobian,
    reach_margin,
    singularity_measures,
)
from dynamics.rigid_body.passive_friction import passive_friction_columns
from dynamics.rigid_body.regressor import platform_columns, rigid_body_regressor
from dynamics.spatial_inertia import spatial_inertia


def inertial_wrench(
    geometry: AnyGeometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX, rigid: ca.SX
) -> ca.SX:
    """Wrench M twist_dot + C twist + G (6,) for parameters `rigid` of the equation of motion.

    It includes the friction of passive joints. It is the product of `rigid_body_regressor` and the
    parameters, computed without the regressor.
    """
    gravity = ca.DM(geometry.gravity)
    layout = geometry.layout
    columns = platform_columns(pose, twist, twist_dot, gravity, layout.full[0])
    total = columns @ rigid[layout.body_slices[0]]
    if layout.passive_names:
        total += passive_friction_columns(geometry, pose, twist) @ rigid[layout.passive]
    for number, (leg, arm) in enumerate(
        zip(geometry.legs, platform_arms(geometry, pose), strict=True)
    ):
        motion = joint_motion(arm, twist, twist_dot)
        bodies = [rigid[body] for body in layout.leg_slices(number)]
        force = leg.force(pose[0:3] + arm, *motion, bodies, gravity)
        total += ca.vertcat(force, ca.cross(arm, force))
    return total


def mass_matrix(geometry: AnyGeometry, pose: ca.SX, rigid: ca.SX) -> ca.SX:
    """Matrix M (6, 6) of eq. 23, symmetric and positive definite for positive parameters."""
    layout = geometry.layout
    total = platform_mass(pose, rigid[layout.body_slices[0]])
    for number, (leg, arm) in enumerate(
        zip(geometry.legs, platform_arms(geometry, pose), strict=True)
    ):
        bodies = [rigid[body] for body in layout.leg_slices(number)]
        at_joint = leg.mass(pose[0:3] + arm, bodies)
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        total += to_joint.T @ at_joint @ to_joint
    return symmetric_from_lower(total)


def coriolis_matrix(geometry: AnyGeometry, pose: ca.SX, twist: ca.SX, rigid: ca.SX) -> ca.SX:
    """Matrix C (6, 6) of eq. 23. C times the twist is the Coriolis and centrifugal wrench."""
    omega = twist[3:6]
    layout = geometry.layout
    frame = rotation_matrix(pose[3:6])
    if layout.full[0]:
        platform = spatial_inertia(rigid[layout.body_slices[0]], frame)
        maps = ca.vertsplit(ca.SX.eye(6), 3)
        forces, moments = platform.coriolis_parts(maps, 2 * [ca.SX(3, 6)], twist[0:3], omega)
        total = forces + moments
    else:
        gyroscopic = ca.skew(omega) @ frame @ ca.diag(rigid[1:4]) @ frame.T
        total = ca.diagcat(ca.SX.zeros(3, 3), gyroscopic)
    for number, (leg, arm) in enumerate(
        zip(geometry.legs, platform_arms(geometry, pose), strict=True)
    ):
        bodies = [rigid[body] for body in layout.leg_slices(number)]
        position = pose[0:3] + arm
        coriolis = leg.coriolis(position, twist[0:3] + ca.cross(omega, arm), bodies)
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        to_joint_rate = ca.horzcat(ca.SX.zeros(3, 3), -ca.skew(ca.cross(omega, arm)))
        total += to_joint.T @ (coriolis @ to_joint + leg.mass(position, bodies) @ to_joint_rate)
    return total


def platform_mass(pose: ca.SX, platform: ca.SX) -> ca.SX:
    """Mass matrix (6, 6) of the platform alone for inertial parameters (4,), or (10,) if full."""
    inertia = spatial_inertia(platform, rotation_matrix(pose[3:6]))
    linear = inertia.mass * ca.SX.eye(3)
    if inertia.first_moment is None:
        return ca.diagcat(linear, inertia.inertia)
    first = ca.skew(inertia.first_moment)
    return ca.vertcat(ca.horzcat(linear, -first), ca.horzcat(first, inertia.inertia))


def kinematic_functions(geometry: AnyGeometry) -> list[ca.Function]:
    """Functions of pose and rates: joints, reach, closure, Jacobians, twists and placements."""
    pose = ca.SX.sym("pose", 6)
    rate = ca.SX.sym("pose_rate", 6)
    acceleration = ca.SX.sym("pose_acceleration", 6)
    twist = ca.SX.sym("twist", 6)
    theta = ca.SX.sym("theta", len(geometry.legs))
    to_twist = pose_rate_to_twist(pose)
    return [
        function(
            "inverse_kinematics",
            [pose, *geometry.symbols],
            [joint_coordinates(geometry, pose), reach_margin(geometry, pose)],
        ),
        function(
            "loop_closure",
            [pose, theta, *geometry.symbols],
            list(loop_closure(geometry, pose, theta)),
        ),
        function(
            "singularity_measures",
            [pose, *geometry.symbols],
            list(singularity_measures(geometry, pose)),
        ),
        function("joint_jacobian", [pose, *geometry.symbols], [joint_jacobian(geometry, pose)]),
        function("pose_jacobian", [pose, *geometry.symbols], [pose_jacobian(geometry, pose)]),
        function("twist", [pose, rate, *geometry.symbols], [to_twist @ rate]),
        function(
            "twist_dot",
            [pose, rate, acceleration, *geometry.symbols],
            [to_twist @ acceleration + twist_bias(pose, rate)],
        ),
        function("pose_rate", [pose, twist, *geometry.symbols], [ca.solve(to_twist, twist)]),
        function(
            "placements", [pose, twist, *geometry.symbols], [placements(geometry, pose, twist)]
        ),
    ]


def dynamic_functions(geometry: AnyGeometry) -> list[ca.Function]:
    """Functions for M, C, G, friction and regressor (eq. 23-26), and for dynamics (eq. 17, 40).

    Wrenches have six entries. The legs balance the entries along which the platform cannot move.
    These entries have no effect on the torques.
    """
    layout = geometry.layout
    pose = ca.SX.sym("pose", 6)
    twist = ca.SX.sym("twist", 6)
    twist_dot = ca.SX.sym("twist_dot", 6)
    torque = ca.SX.sym("torque", layout.joints)
    xi = ca.SX.sym("parameters", len(layout.dynamic_names))
    rigid = xi[layout.rigid]
    jacobian = joint_jacobian(geometry, pose)
    velocity = jacobian @ twist
    friction = xi[layout.coulomb] * ca.sign(velocity) + xi[layout.viscous] * velocity
    inertial = inertial_wrench(geometry, pose, twist, twist_dot, rigid)
    bias = inertial_wrench(geometry, pose, twist, ca.SX.zeros(6), rigid)
    holding = inertial_wrench(geometry, pose, ca.SX(6, 1), ca.SX(6, 1), rigid)
    mass = mass_matrix(geometry, pose, rigid)
    basis = pose_basis(geometry)
    diagonal, upper, order = ca.ldl(symmetric_from_lower(basis.T @ mass @ basis))
    acceleration = basis @ ca.ldl_solve(
        basis.T @ (jacobian.T @ (torque - friction) - bias), diagonal, upper, order
    )
    # Coulomb and viscous friction of eq. 24, without its second v_E, which is a misprint
    friction_columns = [jacobian.T @ ca.diag(ca.sign(velocity)), jacobian.T @ ca.diag(velocity)]
    regressor = ca.horzcat(
        rigid_body_regressor(geometry, pose, twist, twist_dot), *friction_columns
    )
    passive = passive_friction_columns(geometry, pose, twist) @ xi[layout.passive]
    friction_wrench = (
        jacobian.T @ friction + passive if layout.passive_names else jacobian.T @ friction
    )
    torques = ca.solve((jacobian @ basis).T, basis.T @ inertial) + friction
    return [
        function("mass_matrix", [pose, xi, *geometry.symbols], [mass]),
        function(
            "coriolis_matrix",
            [pose, twist, xi, *geometry.symbols],
            [coriolis_matrix(geometry, pose, twist, rigid)],
        ),
        function("gravity_wrench", [pose, xi, *geometry.symbols], [holding]),
        function("friction_wrench", [pose, twist, xi, *geometry.symbols], [friction_wrench]),
        function("regressor", [pose, twist, twist_dot, *geometry.symbols], [regressor]),
        function("inverse_dynamics", [pose, twist, twist_dot, xi, *geometry.symbols], [torques]),
        function("forward_dynamics", [pose, twist, torque, xi, *geometry.symbols], [acceleration]),
    ]


def robot_functions(geometry: AnyGeometry) -> list[ca.Function]:
    """Functions that `Robot` evaluates."""
    return kinematic_functions(geometry) + dynamic_functions(geometry)
