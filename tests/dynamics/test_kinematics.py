"""Jacobians and twists against numerical differentiation."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dynamics.errors import ConvergenceError, UnreachablePoseError


def _vector(matrix):
    return np.array([matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def test_pose_jacobian_is_the_derivative_of_the_inverse_kinematics(robot, states, numerics):
    """J_theta equals finite differences of the crank angles along each pose coordinate (1e-9)."""
    for pose in states.pose[:10]:
        columns = [numerics.derivative(lambda d, e=e, p=pose: robot.inverse_kinematics(p + d * e)) for e in np.eye(6)]
        np.testing.assert_allclose(robot.pose_jacobian(pose), np.column_stack(columns), atol=1e-9)


def test_joint_jacobian_is_the_derivative_along_a_screw_motion(robot, states, numerics):
    """J_ad times a twist equals finite differences of the angles while scipy turns the platform about base axes."""
    for pose, twist in zip(states.pose[:20], states.twist[:20], strict=True):
        start = Rotation.from_euler("XYZ", pose[3:])

        def angles(t, pose=pose, twist=twist, start=start):
            turned = (Rotation.from_rotvec(t * twist[3:]) * start).as_euler("XYZ")
            return robot.inverse_kinematics(np.concatenate([pose[:3] + t * twist[:3], turned]))

        np.testing.assert_allclose(robot.joint_jacobian(pose) @ twist, numerics.derivative(angles), atol=1e-10)


def test_twist_is_the_angular_velocity_of_the_rotation(robot, motion, numerics):
    """Eq. 2: [omega]x = R_dot R^T with R differentiated numerically; h_dot is the pose rate itself."""
    for t in np.linspace(0, 2, 9):
        rotation = numerics.base_from_platform(motion.pose(t))
        rate = numerics.derivative(lambda d, t=t: numerics.base_from_platform(motion.pose(t + d)))
        expected = np.concatenate([motion.rate(t)[:3], _vector(rate @ rotation.T)])
        twist = robot.twist(motion.pose(t), motion.rate(t))
        np.testing.assert_allclose(twist, expected, atol=1e-11)
        np.testing.assert_allclose(robot.pose_rate(motion.pose(t), twist), motion.rate(t), atol=1e-14)


def test_twist_dot_is_the_angular_acceleration_of_the_rotation(robot, motion, numerics):
    """Eq. 38: [omega_dot]x = R_ddot R^T + R_dot R_dot^T with R differentiated twice numerically."""
    for t in np.linspace(0, 2, 9):

        def turned(d, t=t):
            return numerics.base_from_platform(motion.pose(t + d))

        rate, second = numerics.derivative(turned), numerics.second_derivative(turned)
        omega_dot = _vector(second @ turned(0.0).T + rate @ rate.T)
        expected = np.concatenate([motion.acceleration(t)[:3], omega_dot])
        result = robot.twist_dot(motion.pose(t), motion.rate(t), motion.acceleration(t))
        np.testing.assert_allclose(result, expected, atol=1e-8)


def test_forward_kinematics_returns_the_pose_over_the_travel_range(robot):
    """From home, Newton finds every pose of a box twice the usual one with cranks within travel, to 1e-12 m and rad."""
    rng = np.random.default_rng(3)
    poses, angles = [], []
    for offset in rng.uniform(-1, 1, (300, 6)):
        pose = robot.home_pose + offset * [0.022, 0.022, 0.022, 0.088, 0.088, 0.088]
        with contextlib.suppress(UnreachablePoseError):
            theta = robot.inverse_kinematics(pose)
            if np.abs(theta).max() <= robot.travel_limit:
                poses.append(pose)
                angles.append(theta)
    assert len(poses) >= 200
    assert np.abs(angles).max() > 0.95 * robot.travel_limit
    found = robot.forward_kinematics(np.array(angles))
    np.testing.assert_allclose(found, poses, atol=1e-12)
    np.testing.assert_array_equal(robot.forward_kinematics(angles[0]), found[0])


@settings(max_examples=40, deadline=None)
@given(theta=st.lists(st.floats(-0.9948, 0.9948), min_size=6, max_size=6).map(np.array))
def test_forward_kinematics_solves_or_says_that_it_cannot(robot, theta):
    """For any angles within travel the result has these angles to 1e-12 rad, or ConvergenceError says no."""
    try:
        pose = robot.forward_kinematics(theta)
    except ConvergenceError:
        return
    np.testing.assert_allclose(robot.inverse_kinematics(pose), theta, atol=1e-12)


def test_impossible_angles_are_refused(robot):
    """Cranks turned so that neighbours pull the platform apart admit no pose."""
    with pytest.raises(ConvergenceError, match=r"residual of .* limit 1e-12"):
        robot.forward_kinematics([3.0, -3.0, 3.0, -3.0, 3.0, -3.0])
