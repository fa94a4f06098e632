"""Jacobians and twists against numerical differentiation."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynamics.errors import ConvergenceError, ShapeError
from tests.dynamics.conftest import base_from_platform, derivative, of_legs


def test_pose_jacobian_is_the_derivative_of_the_inverse_kinematics(robot, states):
    """J_theta equals finite differences of the crank angles along each pose coordinate (1e-9)."""
    for pose in states.pose[:10]:
        columns = [
            derivative(lambda d, e=e, p=pose: robot.inverse_kinematics(p + d * e))
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(robot.pose_jacobian(pose), np.column_stack(columns), atol=1e-9)


def test_joint_jacobian_is_the_derivative_along_a_screw_motion(robot, states):
    """J_ad times a twist equals finite differences of the angles while scipy turns the platform
    about base axes.
    """
    for pose, twist in zip(states.pose[:20], states.twist[:20], strict=True):
        start = Rotation.from_euler("XYZ", pose[3:])

        def angles(t, pose=pose, twist=twist, start=start):
            turned = (Rotation.from_rotvec(t * twist[3:]) * start).as_euler("XYZ")
            return robot.inverse_kinematics(np.concatenate([pose[:3] + t * twist[:3], turned]))

        np.testing.assert_allclose(
            robot.joint_jacobian(pose) @ twist, derivative(angles), atol=1e-10
        )


def test_twist_is_the_velocity_of_place_and_rotation_and_twist_dot_its_derivative(robot, motion):
    """Eq. 2: [omega]x = R_dot R^T with R differentiated numerically; eq. 38 against differences of
    that twist.
    """
    for t in np.linspace(0, 2, 9):
        pose, rate, acceleration = motion(t)
        turning = (
            derivative(lambda d, t=t: base_from_platform(motion(t + d)[0]))
            @ base_from_platform(pose).T
        )
        twist = robot.twist(pose, rate)
        np.testing.assert_allclose(twist[:3], rate[:3], atol=1e-11)
        np.testing.assert_allclose(
            twist[3:], [turning[2, 1], turning[0, 2], turning[1, 0]], atol=1e-11
        )
        np.testing.assert_allclose(robot.pose_rate(pose, twist), rate, atol=1e-14)
        expected = derivative(lambda d, t=t: robot.twist(*motion(t + d)[:2]))
        np.testing.assert_allclose(robot.twist_dot(pose, rate, acceleration), expected, atol=1e-8)


def followed_from_home(geometry, theta, steps=40):
    """Oracle: poses (N, 6) reached from home while all cranks turn evenly, loops kept closed in
    base axes by scipy's rotations; and the smallest determinant of J_a2 on the way, as a share of
    that at home."""
    zero, leg = of_legs(geometry, "crank_zero_direction"), geometry.legs[0]
    across = np.cross(of_legs(geometry, "crank_axis"), zero)
    places = np.tile(geometry.home_pose[:3], (len(theta), 1))
    turns = Rotation.from_euler("XYZ", np.tile(geometry.home_pose[3:], (len(theta), 1)))
    least, at_home = np.inf, None
    for share in np.linspace(0, 1, steps + 1):
        cosine, sine = np.cos(share * theta)[..., None], np.sin(share * theta)[..., None]
        tips = geometry.base_joints + leg.crank_length * (cosine * zero + sine * across)
        for _ in range(4):
            arms = np.einsum("nij,lj->nli", turns.as_matrix(), geometry.platform_joints)
            links = places[:, None] + arms - tips
            gaps = (np.sum(links**2, axis=2) - leg.link_length**2) / 2
            rows = np.concatenate([links, np.cross(arms, links)], axis=2)
            step = -np.linalg.solve(rows, gaps[..., None])[..., 0]
            places, turns = places + step[:, :3], Rotation.from_rotvec(step[:, 3:]) * turns
        determinants = np.linalg.det(rows)
        at_home = determinants if at_home is None else at_home
        least = np.minimum(least, determinants / at_home)
    return np.hstack([places, turns.as_euler("XYZ")]), least


@pytest.mark.slow
def test_every_joint_vector_within_travel_has_one_pose_that_newton_finds_from_home(robot):
    """All 729 combinations of -limit, 0, +limit and 1500 random ones: the pose is the one reached
    by turning the cranks evenly from home (1e-12), no singularity is met on the way, and the angles
    come back to 1e-12 rad."""
    rng, limit = np.random.default_rng(5), robot.travel_limit
    corners = limit * np.array(list(itertools.product([-1, 0, 1], repeat=6)))
    theta = np.concatenate([corners, rng.uniform(-limit, limit, (1500, 6))])
    expected, least = followed_from_home(robot.geometry, theta)
    assert least.min() > 0.2
    found = robot.forward_kinematics(theta)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(robot.inverse_kinematics(found), theta, atol=1e-12)


def test_rows_that_have_no_pose_are_named_with_leg_and_residual_or_as_folded_the_other_way(robot):
    """Far beyond the travel the legs can close with a crank on its other side, where the closed
    form never is.
    """
    with pytest.raises(
        ConvergenceError, match=r"\(row 1\) in \d+ steps: .*joint \d is off by .*, limit 1e-12"
    ):
        robot.forward_kinematics([np.zeros(6), [3.0, -3.0, 3.0, -3.0, 3.0, -3.0], np.zeros(6)])
    with pytest.raises(
        ConvergenceError, match=r"\(row 0\) .* closes the loops, but leg \d is folded the other way"
    ):
        robot.forward_kinematics([1.2393, -1.4656, -0.0294, 1.3016, 0.6802, 0.0804])


def test_forward_kinematics_starts_where_it_is_told(robot, states):
    """A start for each row, one for all, and a start out of reach lead to the same poses; other
    shapes are refused.
    """
    theta = robot.inverse_kinematics(states.pose)
    for start in (
        states.pose,
        states.pose[::-1],
        robot.home_pose,
        robot.home_pose + 0.3 * np.eye(6)[0],
    ):
        np.testing.assert_allclose(robot.forward_kinematics(theta, start), states.pose, atol=1e-12)
    with pytest.raises(ShapeError, match=r"initial_pose has shape \(3, 6\)"):
        robot.forward_kinematics(theta, states.pose[:3])
    with pytest.raises(ShapeError, match=r"initial_pose has shape \(300, 6\)"):
        robot.forward_kinematics(theta[0], states.pose)
    assert robot.forward_kinematics(np.zeros((0, 6))).shape == (0, 6)
