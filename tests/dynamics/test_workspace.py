"""Travel, reach and singularity measures, against geometry worked out leg by leg without the
package's Jacobians.
"""

import numpy as np
import pytest

import dynamics
from dynamics import workspace
from dynamics.errors import SingularPoseError, TravelError, UnreachablePoseError
from tests.dynamics.conftest import of_legs, place_legs


def test_reach_margin_is_that_of_the_law_of_cosines(robot, states):
    """1 - cos^2 of the angle between crank and reach in each crank's plane, in reach and out
    of it."""
    g, poses = (
        robot.geometry,
        np.vstack([states.pose[:20], robot.home_pose + 0.2 * np.eye(6)[0], robot.home_pose + 1]),
    )
    np.testing.assert_array_equal(
        workspace.measure(robot, poses).reach_margin, robot.reach_margin(poses)
    )
    for pose, margin in zip(poses, robot.reach_margin(poses), strict=True):
        reach = place_legs(g, pose, np.zeros(6)).joint - g.base_joints
        square = np.sum(reach**2, axis=1)
        in_plane = square - np.sum(reach * of_legs(g, "crank_axis"), axis=1) ** 2
        crank, link = of_legs(g, "crank_length"), of_legs(g, "link_length")
        cosine = (square + crank**2 - link**2) / (2 * crank) / np.sqrt(in_plane)
        np.testing.assert_allclose(margin, 1 - cosine**2, rtol=1e-12, atol=1e-12)


def test_leverage_and_conditions_are_those_of_the_joints_places(robot, states, legs_at):
    """Leverage is the sine between crank plane and link, |(w x l) . s| / (|w| |l|). The wrench of
    unit forces along the links, torques over 0.2 m, has the platform side's condition number
    (virtual work)."""
    assert robot.geometry.characteristic_length == pytest.approx(0.2, abs=1e-12)
    measures = workspace.measure(robot, states.pose)
    for row, pose in enumerate(states.pose[:20]):
        legs = legs_at(pose)
        along = (legs.joint - legs.tip) / robot.geometry.legs[0].link_length
        np.testing.assert_allclose(
            measures.leverage[row], np.abs(np.cross(legs.crank, along)[:, 2]) / 0.06, atol=1e-12
        )
        wrench = np.hstack([along, np.cross(legs.joint - pose[:3], along) / 0.2])
        assert measures.platform_condition[row] == pytest.approx(np.linalg.cond(wrench), rel=1e-9)
        scaled = robot.joint_jacobian(pose) / [1, 1, 1, 0.2, 0.2, 0.2]
        assert measures.joint_condition[row] == pytest.approx(np.linalg.cond(scaled), rel=1e-9)


def test_the_whole_travel_of_the_reference_robot_is_regular(robot):
    """5000 joint vectors within travel: leverage stays above 0.09 and the conditions below 5 and
    10.
    """
    theta = np.random.default_rng(1).uniform(-1, 1, (5000, 6)) * robot.travel_limit
    measures = workspace.measure(robot, robot.forward_kinematics(theta))
    assert measures.reachable.all()
    np.testing.assert_allclose(
        measures.travel_share, np.abs(theta).max(axis=1) / 0.9948, atol=1e-11
    )
    assert measures.leverage.min() > 0.09
    assert measures.platform_condition.max() < 5
    assert measures.joint_condition.max() < 10
    assert np.abs(measures.theta).max() < robot.travel_limit + 1e-9


def test_poses_out_of_reach_are_nan_and_only_they(robot, recwarn):
    """Where squares overflow the reach margin is -inf, the rest NaN, and NumPy has nothing to warn
    of.
    """
    poses = np.array(
        [robot.home_pose, robot.home_pose + 0.2 * np.eye(6)[0], np.full(6, 1e308), robot.home_pose]
    )
    measures = workspace.measure(robot, poses)
    np.testing.assert_array_equal(measures.reachable, [True, False, False, True])
    for name in ("theta", "leverage", "platform_condition", "joint_condition", "travel_share"):
        lacking = np.isnan(getattr(measures, name)).reshape(4, -1)
        np.testing.assert_array_equal(lacking.all(axis=1), [False, True, True, False], err_msg=name)
        assert not lacking[[0, 3]].any()
    assert -np.inf < measures.reach_margin[1].min() < 0
    assert measures.reach_margin[2].max() == -np.inf
    with pytest.raises(UnreachablePoseError, match="reach margin of leg 1 of rss6 is -inf"):
        workspace.check_motion(robot, poses[2])
    assert not recwarn.list
    assert workspace.measure(robot, np.zeros((0, 6))).theta.shape == (0, 6)


def along_x(robot, largest, count=41):
    return robot.home_pose + np.linspace(0, largest, count)[:, None] * np.eye(6)[0]


def test_the_worst_of_a_good_motion_comes_with_its_time_and_leg(robot):
    """Largest |theta| and least leverage of a straight line are found where the measures have
    them."""
    poses, times = along_x(robot, 0.02), np.linspace(0, 2, 41)
    worst = workspace.check_motion(robot, poses, times)
    theta = np.abs(robot.inverse_kinematics(poses))
    assert worst.travel.value == theta.max()
    assert (worst.travel.time, worst.travel.limit) == (2.0, 0.9948)
    assert worst.travel.leg == np.argmax(theta[-1]) + 1
    measures = workspace.measure(robot, poses)
    assert worst.leverage.value == measures.leverage.min()
    assert worst.condition.value == measures.platform_condition.max()
    assert worst.condition.leg is None
    assert np.isnan(workspace.check_motion(robot, poses[0]).reach.time)


@pytest.mark.parametrize(
    ("largest", "options", "error", "words"),
    [
        (
            0.06,
            {},
            TravelError,
            r"\|theta\| in rad of leg \d of rss6 is 1\.\d+ at t = 2 s, limit 0\.9948",
        ),
        (0.02, {"times": None, "travel_margin": 0.8}, TravelError, r"at row 40, limit 0\.1948"),
        (
            0.3,
            {},
            UnreachablePoseError,
            r"reach margin of leg \d of rss6 is -.* at t = 1\.\d+ s, must be > 0",
        ),
        (
            0.02,
            {"least_leverage": 0.9},
            SingularPoseError,
            r"\(J_a1\) of leg \d of rss6 is 0\.\d+ .*must be >= 0\.9",
        ),
        (
            0.02,
            {"most_condition": 1.2},
            SingularPoseError,
            r"condition of J_a2 of rss6 is 1\.\d+ .*limit 1\.2",
        ),
    ],
)
def test_a_bad_motion_is_refused_with_time_leg_value_and_limit(
    robot, largest, options, error, words
):
    with pytest.raises(error, match=words):
        workspace.check_motion(
            robot, along_x(robot, largest), **{"times": np.linspace(0, 2, 41), **options}
        )


@pytest.mark.thorough
def test_a_platform_that_moves_with_locked_cranks_is_found_and_refused(robot, load_changed):
    """Links in the plane of the platform carry no vertical force: the condition of J_a2 says so,
    leverage does not. M is regular there, so that eq. 40 still holds: the platform falls freely,
    whatever the torques."""
    legs = robot.geometry
    tips = legs.base_joints + 0.06 * of_legs(legs, "crank_zero_direction")
    link = np.linalg.norm(legs.platform_joints - tips, axis=1)[0]
    robot = load_changed(
        {
            "home_pose = [0.0, 0.0, 0.2,": "home_pose = [0.0, 0.0, 0.0,",
            "link_length = 0.30133373938841": f"link_length = {link:.17g}",
        }
    )
    pose, rest, torque = robot.home_pose, np.zeros(6), np.linspace(-1, 1, 6)
    measures = workspace.measure(robot, pose)
    assert measures.platform_condition[0] > 1e12
    assert measures.leverage.min() > 0.5
    with pytest.raises(SingularPoseError, match=r"condition of J_a2 .*limit 20"):
        workspace.check_motion(robot, pose)
    with pytest.raises(
        SingularPoseError, match=r"singular at pose \[0. 0. 0. .*condition of J_ad .*limit 1e\+10"
    ):
        robot.forward_dynamics(pose, rest, torque)
    with pytest.raises(SingularPoseError):
        robot.inverse_dynamics([pose, pose], rest, rest)
    wrench = robot.joint_jacobian(pose).T @ torque - robot.gravity_wrench(pose)
    expected = np.linalg.solve(robot.mass_matrix(pose), wrench)
    found = dynamics.fast_forward_dynamics(robot)(pose, rest, torque)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert found[2] < -9.0
