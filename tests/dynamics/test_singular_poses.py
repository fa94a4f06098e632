"""Poses without an answer: links that carry no vertical force, Euler angles at their limit, bodies without inertia."""

import numpy as np
import pytest

from dynamics.errors import SingularPoseError
from dynamics.robot import fast_forward_dynamics


@pytest.fixture
def flat_robot(robot, load_changed, monkeypatch):
    """A robot whose links all lie in the plane of the platform: they carry no vertical force, J_a2 is singular."""
    monkeypatch.setattr("dynamics.robot.load_library", lambda *_: None)  # one robot is not worth compiling
    legs = robot.geometry
    tips = legs.base_joints + legs.crank_length * legs.crank_zero_directions
    flat = np.linalg.norm(legs.platform_joints - tips, axis=1)[0]
    return load_changed(
        {
            "home_pose = [0.0, 0.0, 0.2,": "home_pose = [0.0, 0.0, 0.0,",
            "link_length = 0.30133373938841": f"link_length = {flat:.17g}",
        }
    )


def test_singular_poses(flat_robot):
    """Where the links carry no vertical force the robot refuses, naming condition and limit."""
    robot = flat_robot
    with pytest.raises(SingularPoseError, match=r"singular at pose \[0. 0. 0. .*condition of J_ad .*limit 1e\+10"):
        robot.forward_dynamics(robot.home_pose, np.zeros(6), np.zeros(6))
    with pytest.raises(SingularPoseError):
        robot.inverse_dynamics([robot.home_pose, robot.home_pose], np.zeros(6), np.zeros(6))


def test_the_fast_forward_dynamics_solves_equation_40_where_the_links_carry_no_vertical_force(flat_robot):
    """M is regular there: the platform falls freely, whatever the torques."""
    pose, rest, torque = flat_robot.home_pose, np.zeros(6), np.linspace(-1, 1, 6)
    wrench = flat_robot.joint_jacobian(pose).T @ torque - flat_robot.gravity_wrench(pose)
    expected = np.linalg.solve(flat_robot.mass_matrix(pose), wrench)
    found = fast_forward_dynamics(flat_robot)(pose, rest, torque)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert found[2] < -9.0


def test_euler_angles_at_their_singularity(robot):
    """Pose rates have no value at beta = pi/2."""
    with pytest.raises(SingularPoseError, match=r"beta = \+-pi/2"):
        robot.pose_rate([0, 0, 0.2, 0, np.pi / 2, 0], np.ones(6))


def test_bodies_without_inertia_give_an_error_and_no_nan(robot):
    """Only a mass and no inertia anywhere: M is singular, and forward dynamics says so."""
    values = np.zeros(64)
    values[0] = 24.0
    with pytest.raises(SingularPoseError, match="forward_dynamics is not finite"):
        robot.forward_dynamics(robot.home_pose, np.zeros(6), np.ones(6), values)
