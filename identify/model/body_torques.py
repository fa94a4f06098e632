"""Torques along a motion for a unit of each parameter of full bodies and of passive friction.

A model can lack these parameters. The torques of bodies are columns of the regressor of full
bodies, and those of passive joints are the columns of `dynamics.rigid_body.passive_friction`. Both
are evaluated without compiling them, so that no time is spent on compiling a robot with other
parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.interpolate import make_interp_spline

from dynamics.closed_loop import ClosedLoopRun
from dynamics.expressions import function
from dynamics.geometry import RobotGeometry
from dynamics.parameters import passive_parameters
from dynamics.rigid_body.passive_friction import passive_friction_columns
from dynamics.rigid_body.regressor import rigid_body_regressor
from identify.arrays import Array
from identify.filtering import SPLINE_DEGREE

if TYPE_CHECKING:
    from identify.model.loop_model import LoopModel


@dataclass(frozen=True)
class RunMotion:
    """Motion of a run of the model at its frames.

    poses, twists, twist_dots (N, 6). joint_rates (N, n). torque_maps (N, n, 6): matrices that map a
    wrench on the platform to torques of the joints.
    """

    poses: Array
    twists: Array
    twist_dots: Array
    joint_rates: Array
    torque_maps: Array


def run_motion(run: "LoopModel", found: ClosedLoopRun) -> RunMotion:
    """Return the motion of the model in a run."""
    robot = run.robot
    chart = robot.geometry.chart
    poses = chart.pose(chart.coordinates(found.pose))
    rates = chart.lifted(chart.coordinates(found.pose_rate))
    accelerations = make_interp_spline(found.time, rates, k=SPLINE_DEGREE).derivative()(found.time)
    basis = chart.basis
    jacobians = robot.joint_jacobian(poses) @ basis
    maps = np.linalg.inv(jacobians).transpose(0, 2, 1) @ basis.T
    return RunMotion(
        poses=poses,
        twists=robot.twist(poses, rates),
        twist_dots=robot.twist_dot(poses, rates, accelerations),
        joint_rates=joint_rates(run, found),
        torque_maps=maps,
    )


def joint_rates(run: "LoopModel", found: ClosedLoopRun) -> Array:
    """Return the velocities (N, n) of the joints in a run of the model."""
    return np.einsum("nij,nj->ni", run.robot.pose_jacobian(found.pose), found.pose_rate)


def by_the_joints(motion: RunMotion, wrenches: Array) -> Array:
    """Return torques (N, n) of the joints for wrenches (N, 6), less those at the first frame.

    The drives already hold the robot in equilibrium before a motion begins.
    """
    torques = np.einsum("kij,kj->ki", motion.torque_maps, wrenches)
    return np.asarray(torques - torques[0])


# For each of k wrenches, names of the parameters of full bodies that act together.
Together = tuple[tuple[str, ...], ...]


@lru_cache(maxsize=8)
def _body_function(geometry: RobotGeometry, together: Together) -> ca.Function:
    """Return the wrenches (6, k) of `body_wrenches` for given weights, as a CasADi function."""
    state = [ca.SX.sym(name, 6) for name in ("pose", "twist", "twist_dot")]
    full = replace(geometry, full_bodies=("all",))
    regressor = rigid_body_regressor(full, *state)
    indices = [[full.layout.rigid_names.index(name) for name in names] for names in together]
    weights = ca.SX.sym("weights", sum(map(len, indices)))
    parts = ca.vertsplit(weights, [0, *np.cumsum([len(own) for own in indices]).tolist()])
    columns = [regressor[:, own] @ part for own, part in zip(indices, parts, strict=True)]
    return function("body_wrenches", [*state, weights], [ca.horzcat(*columns)])


def body_wrenches(
    geometry: RobotGeometry, motion: RunMotion, together: Together, weights: Sequence[Array]
) -> Array:
    """Return the wrenches (N, 6, k) of parameters of full bodies along a motion.

    weights: for each wrench, the values of the parameters that act together.
    """
    if not together:
        return np.zeros((len(motion.poses), 6, 0))
    state = motion.poses.T, motion.twists.T, motion.twist_dots.T
    values = np.tile(np.concatenate(weights)[:, None], len(motion.poses))
    wrenches = _body_function(geometry, together)(*state, values).full()
    return np.asarray(wrenches.reshape(6, len(motion.poses), -1).transpose(1, 0, 2))


def passive_columns(geometry: RobotGeometry, motion: RunMotion) -> Array:
    """Return the wrenches (N, 6, k) for a unit of each `passive_parameters` along a motion."""
    wrenches = _passive_function(geometry)(motion.poses.T, motion.twists.T).full()
    return np.asarray(wrenches.reshape(6, len(motion.poses), -1).transpose(1, 0, 2))


@lru_cache(maxsize=8)
def _passive_function(geometry: RobotGeometry) -> ca.Function:
    """Return the wrenches (6, k) of `passive_columns` for one pose, as a CasADi function."""
    state = [ca.SX.sym(name, 6) for name in ("pose", "twist")]
    full = replace(geometry, passive_friction=passive_parameters(geometry.legs))
    return function("passive_friction", state, [passive_friction_columns(full, *state)])
