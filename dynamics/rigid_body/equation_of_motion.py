"""Equation of motion in the platform's coordinates, and its derivatives, in CasADi.

The integrator of the closed loop evaluates both. The coordinates q are the entries of the pose that
the chart leaves free. The balance of wrenches is multiplied by T^T (twist = T q_dot, eq. 29):

    M(q) q_ddot + b(q, q_dot) = J_theta^T (torque - friction)

Legs contribute only through the motion of their platform joints A. Derivatives are therefore
computed leg by leg with respect to the motion of A, and multiplied by dA/dq.
"""

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from dynamics.compiled.lanes import ColumnFunction, PartedFunction
from dynamics.expressions import function, symmetric_from_lower
from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import (
    PlatformJointMotion,
    joint_motion,
    pose_rate_to_twist,
    twist_bias,
)
from dynamics.legs.leg import Leg
from dynamics.parameters import LANES
from dynamics.rigid_body.accelerations import (
    STAGES,
    acceleration_in_lanes,
    factored,
    free_acceleration,
    response,
    slope_derivative,
)
from dynamics.rigid_body.jacobians import platform_arms, pose_basis
from dynamics.rigid_body.passive_friction import passive_friction_columns
from dynamics.rigid_body.regressor import platform_columns
from dynamics.rigid_body.virtual_work import platform_mass


def motion_functions(geometry: AnyGeometry) -> list[ca.Function | PartedFunction | ColumnFunction]:
    """Functions that the integrator of the closed loop needs."""
    size = len(geometry.chart.freedoms)
    layout = geometry.layout
    motion = equation_of_motion(geometry)
    free = free_acceleration(size, layout.joints)
    responding = response(size)
    derivatives = motion_derivatives(geometry)
    return [
        motion,
        motion_in_lanes(motion),
        free,
        acceleration_in_lanes(free, responding),
        derivatives,
        derivatives.beside(STAGES, "stage_derivatives"),
        stop_derivatives(geometry),
        rate_map_derivative(geometry),
        responding,
        servo_jacobian(geometry),
        slope_derivative(layout, size),
    ]


def equation_of_motion(geometry: AnyGeometry) -> PartedFunction:
    """Function (q, rate (m,), rigid (p,)) of the equation of motion.

    It returns M (m, m), b (m,), J_theta (n, m), J_theta_dot rate (n,), theta (n,), its rate (n,),
    and the factor of M (m, m) (see `factored`).
    """
    layout = geometry.layout
    q, rate = _coordinates(geometry, "q", "rate")
    pose, pose_rate, _ = _poses(geometry, q, rate, 0 * rate)
    basis = pose_basis(geometry)
    to_twist = pose_rate_to_twist(pose)
    gravity = ca.DM(geometry.gravity)
    twist = to_twist @ pose_rate
    twist_dot = twist_bias(pose, pose_rate)
    twist_map = to_twist @ basis
    rigid = ca.SX.sym("rigid", layout.rigid.stop)
    legs, branches = _legs(geometry)
    parts = []
    for number, (leg, arm) in enumerate(zip(legs, platform_arms(geometry, pose), strict=True)):
        bodies = [rigid[body] for body in layout.leg_slices(number)]
        position = pose[0:3] + arm
        motion = joint_motion(arm, twist, twist_dot)
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        mass = symmetric_from_lower(to_joint.T @ leg.mass(position, bodies) @ to_joint)
        force = leg.force(position, *motion, bodies, gravity)
        row = leg.gradient(position).T @ to_joint @ twist_map
        joint = [leg.acceleration(position, *motion), leg.coordinate(position), row @ rate]
        parts.append([mass, ca.vertcat(force, ca.cross(arm, force)), row, *joint])
    platform = rigid[layout.body_slices[0]]
    mass = platform_mass(pose, platform)
    bias = platform_columns(pose, twist, twist_dot, gravity, layout.full[0]) @ platform
    if layout.passive_names:
        bias += passive_friction_columns(geometry, pose, twist) @ rigid[layout.passive]

    def end(
        masses: Sequence[ca.SX], forces: Sequence[ca.SX], *rows: Sequence[ca.SX]
    ) -> list[ca.SX]:
        wrench_mass = symmetric_from_lower(sum(masses, mass))
        total = symmetric_from_lower(twist_map.T @ wrench_mass @ twist_map)
        return [
            total,
            twist_map.T @ sum(forces, bias),
            *(ca.vertcat(*row) for row in rows),
            factored(total),
        ]

    return _parted("equation_of_motion", [q, rate, rigid, *geometry.symbols], parts, end, branches)


def servo_jacobian(geometry: AnyGeometry) -> PartedFunction:
    """Function q (m,) -> J_theta (n, m), which the servo needs at a measured pose."""
    (q,) = _coordinates(geometry, "q")
    legs, branches = _legs(geometry)
    pose = _poses(geometry, q, 0 * q, 0 * q)[0]
    twist_map = pose_rate_to_twist(pose) @ pose_basis(geometry)
    parts = []
    for leg, arm in zip(legs, platform_arms(geometry, pose), strict=True):
        to_joint = ca.horzcat(ca.SX.eye(3), -ca.skew(arm))
        parts.append([leg.gradient(pose[0:3] + arm).T @ to_joint @ twist_map])

    def end(rows: Sequence[ca.SX]) -> list[ca.SX]:
        return [ca.vertcat(*rows)]

    return _parted("servo_jacobian", [q, *geometry.symbols], parts, end, branches)


def motion_in_lanes(motion: PartedFunction) -> ColumnFunction:
    """Function of the equation of motion for several states of one robot at once.

    The inputs of a column are q and its rate (m,). Its outputs are J_theta_dot rate (n,), theta
    (n,), its rate (n,), the factor of M (m, m), b (m,) and J_theta (n, m).
    """
    single = motion.whole
    inputs = single.sx_in()
    q, rate, *shared = inputs
    _, bias, jacobian, *joints, factor = single.call(inputs)
    lanes = ca.Function("motion_in_lanes", [*shared, q, rate], [*joints, factor, bias, jacobian])
    return ColumnFunction(lanes, len(shared), LANES, LANES)


def motion_derivatives(geometry: AnyGeometry) -> PartedFunction:
    """Function (q, rate, acceleration (m,), torque (n,), rigid (p,)) of derivatives.

    Acceleration and net joint torque are fixed. The function returns the derivatives of M q_ddot +
    b - J_theta^T torque with respect to q (m, m), rate (m, m) and rigid (m, p), and those of the
    joint accelerations with respect to q (n, m) and rate (n, m). The last one is 2 J_theta_dot. The
    solution for q_ddot itself is never differentiated.
    """
    q, rate, acceleration = _coordinates(geometry, "q", "rate", "acceleration")
    motion = _poses(geometry, q, rate, acceleration)
    return _derivatives(
        "motion_derivatives", geometry, [q, rate, acceleration], motion, ca.DM(geometry.gravity)
    )


def stop_derivatives(geometry: AnyGeometry) -> PartedFunction:
    """Function (q, change of rate (m,), impulse (n,), rigid (p,)) of derivatives at a stop.

    It returns the derivatives of M change - J_theta^T impulse with respect to q (m, m), rate (m, m)
    and rigid (m, p). Those with respect to the rate are zero. All are computed as for a motion that
    starts from rest, without gravity, with the acceleration `change`.
    """
    q, change = _coordinates(geometry, "q", "change")
    motion = _poses(geometry, q, 0 * q, change)
    return _derivatives("stop_derivatives", geometry, [q, change], motion, ca.DM.zeros(3), 3)


def _derivatives(
    name: str,
    geometry: AnyGeometry,
    coordinates: list[ca.SX],
    motion: tuple[ca.SX, ca.SX, ca.SX],
    gravity: ca.DM,
    count: int = 5,
) -> PartedFunction:
    """Function of the first `count` outputs of `motion_derivatives`.

    `motion` are pose, rate and acceleration as expressions of `coordinates`.
    """
    layout = geometry.layout
    basis = pose_basis(geometry)
    torque = ca.SX.sym("torque", layout.joints)
    rigid = ca.SX.sym("rigid", layout.rigid.stop)
    joints = _joints(geometry)
    legs, branches = _legs(geometry)
    parts = []
    for number, leg in enumerate(legs):
        bodies = [rigid[body] for body in layout.leg_slices(number)]
        gradient = joints.gradient[number]
        leg_columns, net_force, force, theta_ddot = _leg_derivatives(
            leg, joints.of(number), torque[number], bodies, gravity
        )
        by_pose = gradient.T @ _by_pose(force, joints, number) + joints.curvature(number, net_force)
        by_rate = gradient.T @ _by_rate(force, joints, number)
        of_leg = [
            basis.T @ by_pose @ basis,
            basis.T @ by_rate @ basis,
            basis.T @ gradient.T @ leg_columns,
            _by_pose(theta_ddot, joints, number) @ basis,
            _by_rate(theta_ddot, joints, number) @ basis,
        ]
        parts.append(of_leg[:count])
    platform = _platform_columns(joints, gravity, layout.full[0])
    of_platform = layout.body_slices[0]
    wrench = platform @ rigid[of_platform]
    passive = ca.SX.zeros(6, 0)
    # a stop is treated as a motion from rest, in which passive friction is zero
    if layout.passive_names and count > 3:
        to_twist = pose_rate_to_twist(joints.pose)
        passive = to_twist.T @ passive_friction_columns(
            geometry, joints.pose, to_twist @ joints.rate
        )
        wrench += passive @ rigid[layout.passive]
    by_pose_and_rate = [
        basis.T @ ca.jacobian(wrench, symbol) @ basis for symbol in joints.symbols[:2]
    ]

    def end(
        by_pose: Sequence[ca.SX],
        by_rate: Sequence[ca.SX],
        leg_columns: Sequence[ca.SX],
        *of_joints: Sequence[ca.SX],
    ) -> list[ca.SX]:
        columns = ca.SX.zeros(basis.shape[1], layout.rigid.stop)
        columns[:, of_platform] = basis.T @ platform
        if passive.shape[1]:
            columns[:, layout.passive] = basis.T @ passive
        for number, of_leg in enumerate(leg_columns):
            slices = layout.leg_slices(number)
            ends = np.cumsum([0, *(rows.stop - rows.start for rows in slices)]).tolist()
            for rows, part in zip(slices, ca.horzsplit(of_leg, ends), strict=True):
                columns[:, rows] = part
        return [
            sum(by_pose, by_pose_and_rate[0]),
            sum(by_rate, by_pose_and_rate[1]),
            columns,
            *(ca.vertcat(*rows) for rows in of_joints),
        ]

    inputs = [*coordinates, torque, rigid, *geometry.symbols]
    return _parted(name, inputs, parts, end, branches, (joints.symbols, motion))


def rate_map_derivative(geometry: AnyGeometry) -> ca.Function:
    """Function (q, g) -> d(J_theta g)/dq (n, m) for a constant rate g (m,)."""
    q, rate = _coordinates(geometry, "q", "rate")
    motion = _poses(geometry, q, rate, 0 * rate)
    joints = _joints(geometry)
    rows = []
    for number, leg in enumerate(geometry.legs):
        position = ca.SX.sym("position", 3)
        gradient = leg.gradient(position)
        curvature = ca.substitute(
            ca.jacobian(gradient, position), position, joints.position[number]
        )
        at_joint = ca.substitute(gradient, position, joints.position[number])
        # the velocity of A and the gradient of the leg both depend on q
        by_gradient = joints.velocity[number].T @ curvature @ joints.gradient[number]
        rows.append(at_joint.T @ joints.gradient_rate[number] + by_gradient)
    outputs = [ca.vertcat(*rows) @ pose_basis(geometry)]
    return function(
        "rate_map_derivative", [q, rate, *geometry.symbols], _at(joints, outputs, *motion)
    )


def _coordinates(geometry: AnyGeometry, *names: str) -> list[ca.SX]:
    """Symbols of the coordinates or their derivatives, one vector for each name."""
    return [ca.SX.sym(name, len(geometry.chart.freedoms)) for name in names]


def _poses(
    geometry: AnyGeometry, q: ca.SX, rate: ca.SX, acceleration: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Pose (6,), pose rate and pose acceleration for coordinates (m,) and their derivatives."""
    basis = pose_basis(geometry)
    at_home = ca.SX(ca.DM(geometry.chart.pose(np.zeros(basis.shape[1]))))
    return at_home + basis @ q, ca.densify(basis @ rate), ca.densify(basis @ acceleration)


def _joints(geometry: AnyGeometry) -> PlatformJointMotion:
    """Motion of the joints A, with symbols for pose, rate and acceleration."""
    return PlatformJointMotion(
        geometry.platform_joints, *[ca.SX.sym(name, 6) for name in ("pose", "rate", "acceleration")]
    )


def _parted(
    name: str,
    inputs: list[ca.SX],
    parts: list[list[ca.SX]],
    end: Callable[..., list[ca.SX]],
    branches: tuple[ca.SX, np.ndarray],
    substitution: tuple[Sequence[ca.SX], Sequence[ca.SX]] = ((), ()),
) -> PartedFunction:
    """Function that consists of expressions of each leg, and of expressions that depend on them.

    The arguments of `end` are the first expressions of all legs, then the second ones, and so on.
    `branches` are those of `_legs`. `substitution` has symbols and what replaces them.
    """
    old, new = map(list, substitution)
    columns = [ca.vertcat(*(ca.densify(ca.vec(entry)) for entry in part)) for part in parts]
    symbols = [
        ca.SX.sym(f"leg{number}", column.numel()) for number, column in enumerate(columns, 1)
    ]
    outputs = end(*zip(*map(_shaped, symbols, parts), strict=True))
    return PartedFunction(
        function(f"{name}_parts", [*inputs, branches[0]], ca.substitute(columns, old, new)),
        function(name, [*inputs, *symbols], ca.substitute(outputs, old, new)),
        branches[1],
    )


def _shaped(column: ca.SX, like: list[ca.SX]) -> list[ca.SX]:
    """Split a column into matrices of the same shapes as those of `like`."""
    ends = np.cumsum([0, *(matrix.numel() for matrix in like)]).tolist()
    return [
        ca.reshape(entries, *matrix.shape)
        for entries, matrix in zip(ca.vertsplit(column, ends), like, strict=True)
    ]


def _legs(geometry: AnyGeometry) -> tuple[list[Leg], tuple[ca.SX, np.ndarray]]:
    """Legs with symbols for the signs of their branches, and the symbols with their values.

    Legs that differ only in their branch then have the same expressions.
    """
    symbols = ca.SX.sym("sides", len(geometry.legs))
    pairs = zip(geometry.legs, ca.vertsplit(symbols), strict=True)
    values = np.array([leg.side for leg in geometry.legs], dtype=float)
    return [leg.model_copy(update={"branch": symbol}) for leg, symbol in pairs], (symbols, values)


def _at(joints: PlatformJointMotion, outputs: list[ca.SX], *motion: ca.SX) -> list[ca.SX]:
    """Expressions in which the symbols of the platform's motion are replaced by `motion`."""
    return ca.substitute(outputs, joints.symbols, list(motion))


def _leg_derivatives(
    leg: Leg,
    motion: tuple[ca.SX, ca.SX, ca.SX],
    torque: ca.SX,
    bodies: list[ca.SX],
    gravity: ca.DM,
) -> tuple[ca.SX, ca.SX, list[ca.SX], list[ca.SX]]:
    """Columns (3, p) of a leg's own parameters, net force (3,), and derivatives.

    The derivatives of the force and of theta_ddot are with respect to position, velocity and
    acceleration of A.
    """
    position, velocity, acceleration = (
        ca.SX.sym(name, 3) for name in ("position", "velocity", "acceleration")
    )
    load = leg.force(position, velocity, acceleration, bodies, gravity)
    parameters = [ca.SX.sym("parameters", body.numel()) for body in bodies]
    load_of_parameters = leg.force(position, velocity, acceleration, parameters, gravity)
    columns = ca.jacobian(load_of_parameters, ca.vertcat(*parameters))
    force = load - leg.gradient(position) * torque
    by_acceleration = leg.mass(position, bodies)
    theta_ddot = leg.acceleration(position, velocity, acceleration)
    expressions = [
        columns,
        force,
        ca.jacobian(force, position),
        ca.jacobian(force, velocity),
        by_acceleration,
        ca.jacobian(theta_ddot, position),
        ca.jacobian(theta_ddot, velocity),
        leg.gradient(position).T,
    ]
    inputs = [position, velocity, acceleration]
    columns, force, *rows = ca.substitute(ca.cse(expressions), inputs, list(motion))
    return columns, force, rows[:3], rows[3:]


def _by_pose(rows: list[ca.SX], joints: PlatformJointMotion, leg: int) -> ca.SX:
    """Derivatives with respect to the pose, from derivatives with respect to the motion of A."""
    by_position, by_velocity, by_acceleration = rows
    return (
        by_position @ joints.gradient[leg]
        + by_velocity @ joints.gradient_rate[leg]
        + by_acceleration @ joints.acceleration_by_pose[leg]
    )


def _by_rate(rows: list[ca.SX], joints: PlatformJointMotion, leg: int) -> ca.SX:
    """Derivatives with respect to the pose rate, from those with respect to the motion of A."""
    _, by_velocity, by_acceleration = rows
    return by_velocity @ joints.gradient[leg] + 2 * by_acceleration @ joints.gradient_rate[leg]


def _platform_columns(joints: PlatformJointMotion, gravity: ca.DM, full: bool) -> ca.SX:
    """Columns of the platform's own parameters."""
    to_twist = pose_rate_to_twist(joints.pose)
    twist_dot = to_twist @ joints.symbols[2] + twist_bias(joints.pose, joints.rate)
    twist = to_twist @ joints.rate
    return to_twist.T @ platform_columns(joints.pose, twist, twist_dot, gravity, full)
