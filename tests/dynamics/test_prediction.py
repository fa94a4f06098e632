"""One step of the observer, against simulated plants that stick and slip, and against drawn
velocities.
"""

from dataclasses import replace

import numpy as np
import pytest

import dynamics
from dynamics.closed_loop import (
    Drives,
    FrameTiming,
    LoopSettings,
    Reference,
    ServoGains,
    simulate_commands,
)
from dynamics.control.inverse_dynamics import Model
from dynamics.control.prediction import Prediction, expected_dry_friction, expected_saturation

SETTINGS = LoopSettings(
    ServoGains(0.3, 0.001, 2.4), FrameTiming(25.0), steps_per_frame=40, drives=Drives(torques=True)
)
STEP, PUSHES = 4e-3, np.array([1.1, 0.1, -0.4, 0.02, 0.0, 0.2])


@pytest.mark.parametrize("share", [0.5, 3.0], ids=["some joints rest", "all turn"])
@pytest.mark.parametrize("name", ["rss6", "delta3", "ups6"])
def test_steps_from_rest_end_where_the_simulated_robot_does(name, share):
    """Under torques beyond and below dry friction, which acts as it does in the plant, sticking
    included.
    """
    robot = dynamics.load_robot(name)
    parameters = robot.parameter_sets["truth"].vector
    model = Model(robot, parameters, SETTINGS.friction)
    coulomb = parameters[robot.layout.coulomb]
    torque = (
        robot.static_torque(robot.home_pose, model.dynamic)
        + share * coulomb * 5 * PUSHES[: len(coulomb)]
    )
    poses = np.tile(robot.home_pose, (2, 1))
    run = simulate_commands(
        robot, parameters, Reference(poses, 0 * poses), SETTINGS, commands=np.tile(torque, (2, 1))
    )
    prediction = Prediction(model, SETTINGS)
    at = prediction.blocks
    state = np.zeros(at.size)
    state[at.coordinates] = robot.coordinates(robot.home_pose)
    for _ in range(10):
        state, _ = prediction.step(state, 1e-16 * np.eye(at.size), torque, 0 * torque, STEP)
    free, moved = (
        robot.geometry.chart.basis,
        robot.coordinates(run.pose[1]) - robot.coordinates(robot.home_pose),
    )
    assert (
        np.abs(state[at.coordinates] - robot.coordinates(run.pose[1])).max()
        < 3e-3 * np.abs(moved).max()
    )
    rate = free.T @ run.pose_rate[1]
    assert np.abs(state[at.rates] - rate).max() < 3e-3 * np.abs(rate).max()


@pytest.mark.parametrize("drives", [Drives(torques=True), Drives(), Drives(law="cascade")], ids=str)
def test_the_map_of_errors_is_that_of_differences_of_steps(robot, identified, drives):
    """By states beside each other, with joints that turn: by each part of the state; the offset
    stays.
    """
    model = Model(robot, identified, SETTINGS.friction)
    prediction = Prediction(model, replace(SETTINGS, drives=drives))
    at, rng = prediction.blocks, np.random.default_rng(4)
    state = np.zeros(at.size)
    state[at.coordinates], state[at.rates] = (
        robot.coordinates(robot.home_pose),
        0.01 * rng.standard_normal(6),
    )
    command, state[at.integral] = model.held(robot.home_pose, drives)
    if drives.torques:
        command = robot.static_torque(robot.home_pose, model.dynamic)
    sure, size = 1e-16 * np.eye(at.size), 1e-5
    map_ = prediction.step(state, sure, command, 0 * command, STEP)[1]
    ends = [
        [
            prediction.step(state + sign * size * row, sure, command, 0 * command, STEP)[0]
            for sign in (1, -1)
        ]
        for row in np.eye(at.size)
    ]
    found = np.array([(one - other) / 2 / size for one, other in ends]).T
    for part, near in (
        (at.coordinates, 0.05),
        (at.rates, 0.01),
        (at.integral, 0.01),
        (at.torque, 0.01),
        (at.viscous, 0.2),
    ):
        assert (
            np.abs(found - map_)[at.rates, part].max() <= near * np.abs(map_[at.rates, part]).max()
        )
    assert np.array_equal(map_[at.offset, at.offset], np.eye(6))


def test_expected_saturation_is_the_mean_over_drawn_velocities():
    drawn = np.random.default_rng(1).standard_normal(400_000)
    mean, deviation, reach = (
        np.array([0.0, 0.3, -1.5, 4.0]),
        np.array([1.0, 0.1, 2.0, 0.5]),
        np.array([0.5, 0.4, 1.0, 2.0]),
    )
    share, slope, variance = expected_saturation(mean, deviation, reach)
    found = np.clip((mean[:, None] + deviation[:, None] * drawn) / reach[:, None], -1, 1)
    assert np.abs(share - found.mean(axis=1)).max() < 4e-3
    assert np.abs(variance - found.var(axis=1)).max() < 4e-3
    inside = (np.abs(found) < 1).mean(axis=1) / reach
    assert np.abs(slope - inside).max() < 6e-3


@pytest.mark.parametrize("mean", [0.0, 0.02, 0.1])
def test_friction_of_a_joint_leaves_the_mean_and_the_variance_of_drawn_velocities_of_which_some_rest(
    mean,
):
    """One joint whose friction can take 0.03 of its velocity in a step; its velocity is known to
    0.04.
    """
    drawn = mean + 0.04 * np.random.default_rng(2).standard_normal(400_000)
    left = np.sign(drawn) * np.maximum(np.abs(drawn) - 0.03, 0)
    turned, largest = np.array([[0.01]]), np.array([3.0])
    level, kept = expected_dry_friction(np.array([mean]), np.array([0.04]), turned, largest)
    assert abs(mean - 0.01 * level[0] - left.mean()) < 2e-4
    assert (1 - 0.01 * kept[0]) * 0.04 == pytest.approx(left.std(), rel=5e-3)
