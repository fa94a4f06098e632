"""Robots whose joints are off their nominal places, and the servo that does not know it."""

import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.stats import chi2

from dynamics.robot import with_geometry_error
from tests.dynamics.conftest import Loop, assert_same, place_legs

ERROR = 1e-4
THETA = np.array([0.21, -0.14, 0.3, 0.05, -0.22, 0.11])


@pytest.fixture(scope="module")
def plant(robot):
    return with_geometry_error(robot, ERROR, np.random.default_rng(3))


def test_joint_centres_are_off_by_normal_errors_of_the_given_size(robot):
    """The squares of 40 robots' 36 errors over the variance are chi-square, their mean is zero."""
    plants = [with_geometry_error(robot, ERROR, np.random.default_rng(k)).geometry for k in range(40)]
    names = ("base_joints", "platform_joints")
    errors = np.array([[getattr(plant, name) - getattr(robot.geometry, name) for name in names] for plant in plants])
    assert errors.shape == (40, 2, 6, 3)
    assert 1e-3 < chi2.cdf(np.sum(errors**2) / ERROR**2, errors.size) < 1 - 1e-3
    assert abs(errors.mean()) < 3.3 * ERROR / np.sqrt(errors.size)


def test_the_same_seed_gives_the_same_robot_and_no_error_the_robot_itself(robot, plant):
    assert with_geometry_error(robot, ERROR, np.random.default_rng(3)).geometry == plant.geometry
    assert with_geometry_error(robot, ERROR, np.random.default_rng(4)).geometry != plant.geometry
    assert with_geometry_error(robot, 0.0, np.random.default_rng(3)) is robot


def _gaps(pose, theta, geometry):
    """|A - T| less the link length of every leg."""
    legs = place_legs(geometry, pose, theta)
    return np.linalg.norm(legs.joint - legs.tip, axis=1) - geometry.link_length


def test_the_plant_closes_its_own_loops_at_home_and_elsewhere(robot, plant, monkeypatch):
    """Against MINPACK on the loops; the nominal robot with the same crank angles is elsewhere, by about the error."""
    monkeypatch.setattr("dynamics.robot.load_library", lambda *_: None)
    np.testing.assert_allclose(_gaps(plant.home_pose, np.zeros(6), plant.geometry), 0, atol=1e-15)
    pose = plant.forward_kinematics(THETA)
    solved = fsolve(_gaps, plant.home_pose, args=(THETA, plant.geometry), xtol=1e-13)
    np.testing.assert_allclose(pose, solved, atol=1e-12)
    assert 0.1 * ERROR < np.abs(pose - robot.forward_kinematics(THETA))[:3].max() < 10 * ERROR


@pytest.mark.slow  # compiles the plant
def test_the_servo_commands_with_the_kinematics_it_knows(loop, robot, plant):
    """Eq. 30 worked out from what was measured, with the nominal Jacobian by differences of its inverse kinematics;
    both paths agree, a servo that knows the plant commands otherwise, and one that knows its robot as ever."""
    reference, theirs = loop.reference(40), Loop(plant, loop.parameters)
    run, plain = theirs.both(reference, sensor=lambda k, t, pose: pose, servo_robot=robot)
    assert_same(run, plain)
    assert run.events > 3
    np.testing.assert_allclose(run.pose, plain.pose, atol=1e-13)
    error = reference.poses - run.measured
    before = np.vstack([run.start.last_measured, run.measured[:-1]])
    rate_error = reference.rates - (run.measured - before) * 60.0
    integral = run.start.servo_integral + np.cumsum(error / 60.0, axis=0)
    demand = 0.3 * error + 0.001 * rate_error + 2.4 * integral
    for k in range(12):
        moved = robot.inverse_kinematics(run.measured[k] + 1e-6 * np.vstack([np.eye(6), -np.eye(6)]))
        jacobian = (moved[:6] - moved[6:]).T / 2e-6
        np.testing.assert_allclose(run.command[k], jacobian @ demand[k], atol=1e-8)
    np.testing.assert_allclose(run.command[0], 0, atol=1e-12)  # the plant's cranks at home
    assert np.abs(run.pose - theirs.run(reference, sensor=lambda k, t, pose: pose).pose).max() > 1e-7
    np.testing.assert_array_equal(loop.run(reference, servo_robot=robot).pose, loop.run(reference).pose)
