"""The robot file `rss6` holds the robot that its construction describes."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

BOX = np.array([0.01, 0.01, 0.01, 0.04, 0.04, 0.04])


def _constructed():
    """Platform joints and crank tips at home, from radii and angles; leg order k0-, k0+, k1-, k1+, k2-, k2+."""
    legs = [(k, s) for k in range(3) for s in (-1, 1)]
    angle_a = np.array([2 * np.pi / 3 * k + s * 0.95 for k, s in legs])
    angle_t = np.array([2 * np.pi / 3 * k + s * 0.10 for k, s in legs])
    zero = np.zeros(6)
    joints = 0.200 * np.column_stack([np.cos(angle_a), np.sin(angle_a), zero])
    tips = 0.300 * np.column_stack([np.cos(angle_t), np.sin(angle_t), zero])
    return joints, tips, np.array([s for _, s in legs])


def test_the_file_holds_the_constructed_robot(robot):
    """Joints, cranks, link length and base radius agree with the construction from radii and angles to 1e-14 m."""
    joints, tips, side = _constructed()
    g = robot.geometry
    link = joints + np.array([0, 0, 0.200]) - tips
    along = side[:, None] * np.column_stack([-link[:, 1], link[:, 0], np.zeros(6)])
    along /= np.linalg.norm(link[:, :2], axis=1, keepdims=True)
    np.testing.assert_allclose(g.platform_joints, joints, atol=1e-14)
    np.testing.assert_allclose(g.crank_zero_directions, along, atol=1e-14)
    np.testing.assert_allclose(g.base_joints, tips - 0.060 * along, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(link, axis=1), g.link_length, atol=1e-14)
    np.testing.assert_array_equal(g.crank_axes, np.tile([0, 0, 1], (6, 1)))
    assert (g.crank_length, tuple(g.home_pose), tuple(g.gravity)) == (0.06, (0, 0, 0.2, 0, 0, 0), (0, 0, -9.81))
    assert g.travel_limit == 0.9948


def test_crank_angles_are_zero_at_home(robot):
    """Closed-form inverse kinematics gives zero angles at home, to rounding."""
    np.testing.assert_allclose(robot.inverse_kinematics(robot.home_pose), 0, atol=1e-14)


def test_the_stated_travel_covers_the_box(robot):
    """Over the box +-10 mm, +-0.04 rad (its 64 corners and 5000 poses inside) no crank leaves +-0.803 rad.

    The largest angle is that of a corner, 0.8029 rad.
    """
    corners = np.array(list(itertools.product([-1, 1], repeat=6)))
    inside = np.random.default_rng(0).uniform(-1, 1, (5000, 6))
    theta = robot.inverse_kinematics(robot.home_pose + BOX * np.vstack([corners, inside]))
    np.testing.assert_allclose(np.abs(theta).max(), 0.8029, atol=1e-4)
    assert np.abs(theta).argmax() < 64 * 6


offsets = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


@settings(max_examples=100, deadline=None)
@given(offset=offsets)
def test_legs_close_on_the_branch_of_home(robot, legs_at, offset):
    """From T, built with the angles of the inverse kinematics, A lies one link length away, on the side it has at home.

    The side is the sign of (w x l) . s, which vanishes only where crank and link are stretched or folded.
    """
    place, home = legs_at(robot.home_pose + 1.3 * BOX * offset), legs_at(robot.home_pose)
    link, home_link = place.joint - place.tip, home.joint - home.tip
    np.testing.assert_allclose(np.linalg.norm(link, axis=1), robot.geometry.link_length, rtol=1e-13)
    axes = robot.geometry.crank_axes
    side, home_side = (np.sum(np.cross(p, q) * axes, axis=1) for p, q in ((place.crank, link), (home.crank, home_link)))
    assert (side * home_side > 0).all()


def test_arrays_of_the_geometry_are_frozen(robot):
    """Constants cannot be written to."""
    with pytest.raises(ValueError, match="read-only"):
        robot.geometry.base_joints[0, 0] = 1.0
