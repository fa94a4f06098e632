"""Regressor of the rigid bodies (eq. 25): wrenches for a unit of each parameter, in CasADi.

Wrenches act at the platform origin, in the axes of the base. The regressor of a robot also has
columns for friction of the actuated joints, see `virtual_work.dynamic_functions`.
"""

import casadi as ca
import numpy as np

from dynamics.geometry import AnyGeometry
from dynamics.kinematics.platform import joint_motion, rotation_matrix
from dynamics.rigid_body.jacobians import platform_arms
from dynamics.rigid_body.passive_friction import passive_friction_columns
from dynamics.spatial_inertia import FULL_INERTIAL, spatial_inertia


def rigid_body_regressor(
    geometry: AnyGeometry, pose: ca.SX, twist: ca.SX, twist_dot: ca.SX
) -> ca.SX:
    """Columns of Gamma (6, p) for bodies, and for friction of passive joints (eq. 25)."""
    gravity = ca.DM(geometry.gravity)
    layout = geometry.layout
    columns = ca.SX.zeros(6, layout.rigid.stop)
    columns[:, layout.body_slices[0]] = platform_columns(
        pose, twist, twist_dot, gravity, layout.full[0]
    )
    for number, (leg, arm) in enumerate(
        zip(geometry.legs, platform_arms(geometry, pose), strict=True)
    ):
        slices = layout.leg_slices(number)
        bodies = [ca.SX.sym("parameters", body.stop - body.start) for body in slices]
        force = leg.force(pose[0:3] + arm, *joint_motion(arm, twist, twist_dot), bodies, gravity)
        # the force is linear in the parameters
        forces = ca.jacobian(force, ca.vertcat(*bodies))
        wrenches = ca.vertcat(forces, ca.skew(arm) @ forces)
        ends = np.cumsum([0, *(body.numel() for body in bodies)]).tolist()
        for body, wrench in zip(slices, ca.horzsplit(wrenches, ends), strict=True):
            columns[:, body] = wrench
    columns[:, layout.passive] = passive_friction_columns(geometry, pose, twist)
    return columns


def platform_columns(
    pose: ca.SX, twist: ca.SX, twist_dot: ca.SX, gravity: ca.DM, full: bool
) -> ca.SX:
    """Wrenches of the platform, (6, 4) or (6, 10) if full, for a unit of each parameter."""
    frame = rotation_matrix(pose[3:6])
    omega = twist[3:6]
    omega_dot = twist_dot[3:6]
    if full:
        parameters = ca.SX.sym("parameters", len(FULL_INERTIAL))
        inertia = spatial_inertia(parameters, frame)
        wrench = ca.vertcat(*inertia.load(twist_dot[0:3] - gravity, omega, omega_dot))
        return ca.jacobian(wrench, parameters)
    moments = []
    for axis in range(3):
        direction = frame[:, axis]
        gyroscopic = ca.cross(omega, direction) * ca.dot(direction, omega)
        moments.append(direction * ca.dot(direction, omega_dot) + gyroscopic)
    mass = ca.vertcat(twist_dot[0:3] - gravity, ca.SX.zeros(3))
    return ca.horzcat(mass, ca.vertcat(ca.SX.zeros(3, 3), ca.horzcat(*moments)))
