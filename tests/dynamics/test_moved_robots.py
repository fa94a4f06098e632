"""Robots moved from one by their geometric numbers share its machine code, whose arguments these
are.

The oracle is code of their own: compiled with the numbers as constants.
"""

import numpy as np
import pytest

from dynamics import fast_forward_dynamics, load_robot
from dynamics.bodies import parts_of
from dynamics.closed_loop import (
    FrameTiming,
    LoopSettings,
    Reference,
    ServoGains,
    differentiate_servo,
    simulate_servo,
)
from dynamics.errors import ChartError, RobotFileError, ShapeError, UnreachablePoseError

ROBOTS = [
    "rrr3",
    *[pytest.param(name, marks=pytest.mark.slow) for name in ("rss6",)],
    *[
        pytest.param(name, marks=pytest.mark.thorough)
        for name in ("delta3", "pss6", "pus6", "rus6", "ups6")
    ],
]
SETTINGS = LoopSettings(ServoGains(0.3, 0.001, 2.4), FrameTiming(60.0))


def both(name, size=1e-4, seed=0):
    """The robot moved by errors of that size, m and rad, on its functions, and on functions of its
    own.
    """
    robot = load_robot(name)
    off = size * np.random.default_rng(seed).standard_normal(len(robot.geometry.number_names))
    return robot, robot.moved(off), robot.with_geometry(robot.geometry.moved(off))


def motion(robot, frames=40):
    """A reference that starts moving, for its friction would else decide by rounding which way a
    joint starts.
    """
    time = np.arange(frames)[:, None] / 60.0
    chart = robot.geometry.chart
    amplitude = chart.lifted(np.full((1, len(robot.coordinate_names)), 4e-3))
    speed = 2 * np.pi * np.array([0.7, 0.9, 1.1, 0.8, 1.0, 1.2])
    return Reference(
        robot.home_pose + amplitude * np.sin(speed * time),
        amplitude * speed * np.cos(speed * time) * np.ones((1, 6)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_moved_robot_is_the_robot_with_these_numbers(name):
    robot, moved, own = both(name)
    assert moved.geometry == own.geometry
    assert robot.moved(np.zeros(len(robot.geometry.number_names))).functions_of is robot.geometry
    rng, chart = np.random.default_rng(1), robot.geometry.chart
    poses, twists, rates = (
        at + size * chart.lifted(rng.standard_normal((4, len(robot.coordinate_names))))
        for at, size in ((robot.home_pose, 2e-3), (0.0, 0.1), (0.0, 1.0))
    )
    for method, arguments in (
        ("inverse_kinematics", (poses,)),
        ("inverse_dynamics", (poses, twists, rates)),
    ):
        expected = getattr(own, method)(*arguments)
        np.testing.assert_allclose(
            getattr(moved, method)(*arguments), expected, rtol=1e-11, atol=1e-13
        )
        assert np.abs(getattr(robot, method)(*arguments) - expected).max() > 1e-6
    joints = own.inverse_kinematics(poses[0])
    np.testing.assert_allclose(moved.forward_kinematics(joints), poses[0], atol=1e-12)
    torque = rng.standard_normal(robot.layout.joints)
    found = fast_forward_dynamics(moved)(poses[0], twists[0], torque)
    np.testing.assert_allclose(found, own.forward_dynamics(poses[0], twists[0], torque), rtol=1e-10)


@pytest.mark.parametrize("name", ROBOTS)
def test_rods_are_where_the_frames_of_their_parts_are_and_nowhere_out_of_reach(name):
    """The oracle is NumPy, on code of the robot's own."""
    robot, moved, own = both(name)
    parts, chart = parts_of(own.geometry), own.geometry.chart
    for seed in range(4):
        free = np.random.default_rng(seed).standard_normal(len(robot.coordinate_names))
        pose = own.home_pose + 5e-3 * chart.lifted(free)
        frames = parts.frames(own, pose)
        for k, part in enumerate(parts.all):
            expected = [frames.origin[k] + frames.axes[k] @ end for end in part.segment.rod]
            for one in (own, moved):
                np.testing.assert_allclose(
                    parts_of(one.geometry).rods(one, pose)[k], expected, rtol=0, atol=1e-12
                )
    away = own.home_pose + np.array([5.0, 0, 0, 0, 0, 0])
    with pytest.raises(UnreachablePoseError, match="leg 1"):
        parts.rods(own, away)
    if len(chart.freedoms) < 6:
        with pytest.raises(ChartError, match="beta"):
            parts.rods(own, own.home_pose + np.array([0, 0, 0, 0, 1e-6, 0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_its_closed_loop_is_that_of_code_of_its_own_whatever_the_servo_knows(name):
    robot, moved, own = both(name)
    reference, parameters = motion(robot), robot.parameter_sets["truth"].vector
    expected = differentiate_servo(own, parameters, reference, SETTINGS)
    found = differentiate_servo(moved, parameters, reference, SETTINGS)
    np.testing.assert_allclose(found.pose, expected.pose, rtol=0, atol=1e-12)
    scale = np.abs(expected.pose_sensitivity).max()
    np.testing.assert_allclose(
        found.pose_sensitivity, expected.pose_sensitivity, rtol=1e-6, atol=1e-9 * scale
    )
    other = robot.moved(-robot.geometry.deviations_from(own.geometry) / 2)
    apart = robot.with_geometry(other.geometry)
    for plants, servos in (
        ((moved, own), (robot, robot)),
        ((robot, robot), (moved, own)),
        ((moved, own), (other, apart)),
    ):
        poses = [
            simulate_servo(plant, parameters, reference, SETTINGS, servo_robot=servo).pose
            for plant, servo in zip(plants, servos, strict=True)
        ]
        np.testing.assert_allclose(poses[0], poses[1], rtol=0, atol=1e-12)
        assert np.abs(poses[0] - expected.pose).max() > 1e-7


def test_a_move_of_other_numbers_or_out_of_reach_is_refused():
    robot = load_robot("rrr3")
    with pytest.raises(ShapeError, match="deviations"):
        robot.moved(np.zeros(5))
    with pytest.raises(RobotFileError, match="leg 1 cannot reach"):
        robot.moved(np.eye(len(robot.geometry.numbers))[0])
