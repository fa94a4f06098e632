"""What an exciting trajectory has to keep, against the robot's and the sensor's own figures."""

from dataclasses import replace

import numpy as np
import pytest

from cmmsim.visibility import sight_lines
from dynamics import load_robot
from dynamics.workspace import measure
from identify.errors import TrajectoryError
from identify.excitation import design_trajectories
from identify.excitation.constraints import MotionConstraints, check_periods, required_stickers, within_sight
from identify.scenario import load_scenario
from identify.trajectory import random_trajectory

SCENARIO = load_scenario("quick")


@pytest.fixture(scope="module")
def robot():
    return load_robot("rss6")


def trajectory_of(robot, seed=0, amplitudes=(0.01, 0.04)):
    return random_trajectory(np.random.default_rng(seed), robot.home_pose, 0.1, 5, *amplitudes)


def narrowed(sight, factor):
    """The same rig with longer focal lengths."""
    left, right = (replace(c, focal_px=factor * c.focal_px) for c in sight.rig.cameras)
    return replace(sight, rig=replace(sight.rig, left=left, right=right))


@pytest.mark.parametrize("seed", range(3))
def test_worst_is_what_the_robot_says(robot, seed):
    trajectory, t = trajectory_of(robot, seed), np.arange(400) / 40
    worst = {w.name: w for w in MotionConstraints(robot, SCENARIO).worst(trajectory, t)}
    seen = measure(robot, trajectory.pose(t))
    fine = 1e-4
    rates = robot.inverse_kinematics(trajectory.pose(t + fine)) - robot.inverse_kinematics(trajectory.pose(t - fine))
    assert worst["travel"].value == pytest.approx(np.abs(seen.theta).max(), rel=1e-9)
    assert worst["travel"].limit == pytest.approx(robot.travel_limit - 0.1)
    assert worst["leverage"].value == pytest.approx(seen.leverage.min(), rel=1e-9)
    assert worst["velocity"].value == pytest.approx(np.abs(rates).max() / (2 * fine), rel=1e-5)
    assert worst["conditioning"].value >= seen.platform_condition.max()
    row, leg = np.unravel_index(np.abs(seen.theta).argmax(), seen.theta.shape)
    assert (worst["travel"].who, worst["travel"].time_s) == (f"leg {leg + 1}", t[row])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("travel_margin_rad", 0.8, r"travel of leg \d is 0\.\d+ rad at t = \d+\.\d+ s, limit 0\.1948 rad"),
        ("max_joint_velocity_rad_s", 0.1, r"velocity of leg \d is 0\.\d+ rad/s at t = \d+\.\d+ s, limit 0\.1 rad/s"),
        ("position_amplitude_m", 0.005, r"box of [xyz] is 0\.01 m at t = \d+\.\d+ s, limit 0\.005 m"),
    ],
)
def test_broken_limit_is_named_with_leg_value_limit_and_time(robot, key, value, message):
    constraints = MotionConstraints(robot, SCENARIO.with_overrides({f"excitation.{key}": value}))
    with pytest.raises(TrajectoryError, match=message):
        constraints.check(trajectory_of(robot), np.arange(400) / 40, 1e-3)


@pytest.mark.parametrize("duration_s", [5.0, 13.0])
def test_run_that_cannot_end_at_rest_is_refused(duration_s):
    scenario = SCENARIO.with_overrides({"excitation.duration_s": duration_s, "excitation.method": "gradient"})
    periods = f"{duration_s / 10:g}"
    with pytest.raises(TrajectoryError, match=rf"end at rest: excitation\.duration_s = .* is {periods} periods"):
        check_periods(scenario)


@pytest.mark.parametrize("method", ["random", "gradient"])
@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        ({"excitation.max_joint_velocity_rad_s": 0.01}, r"velocity of leg \d"),
        ({"excitation.position_amplitude_m": 0.06}, r"leg \d"),
        ({"excitation.travel_margin_rad": 0.99}, r"leg \d .*limit 0\.0048"),
    ],
)
def test_no_feasible_start_is_one_line_with_the_reason(robot, method, overrides, reason):
    scenario = SCENARIO.with_overrides({**overrides, "excitation.method": method, "excitation.candidates": 1})
    with pytest.raises(TrajectoryError, match=reason) as error:
        design_trajectories(robot, scenario, seed=0)
    assert "\n" not in str(error.value)


def test_margin_that_leaves_no_travel_is_refused(robot):
    with pytest.raises(TrajectoryError, match=r"travel_margin_rad = 1 rad leaves nothing of the travel limit 0\.9948"):
        MotionConstraints(robot, SCENARIO.with_overrides({"excitation.travel_margin_rad": 1.0}))


def test_box_that_is_said_to_be_in_sight_is(robot):
    sight, box = sight_lines("ctrack780"), np.repeat([0.01, 0.04], 3)
    chosen = required_stickers(sight, robot.home_pose)
    assert len(chosen) == 12
    assert within_sight(sight, chosen, robot.home_pose, box)
    for signs in np.random.default_rng(0).choice([-1.0, 1.0], (40, 6)):
        assert sight.visible(robot.home_pose + signs * box)[chosen].all()


def test_sight_counts_where_the_box_is_not_proved_to_be_in_it(robot):
    """A narrow image: the shares that are within one are those of stickers that the cameras can look for."""
    sight = narrowed(sight_lines("ctrack780"), 1.5)
    scenario = SCENARIO.with_overrides({"excitation.position_amplitude_m": 0.1})
    constraints = MotionConstraints(robot, scenario, sight)
    assert not constraints.always_in_sight
    chosen = required_stickers(sight, robot.home_pose)
    function, rng, lost = constraints.shares_of(["visibility"]), np.random.default_rng(1), 0
    for offset in rng.uniform(-1, 1, (100, 6)) * np.repeat([0.1, 0.5], 3):
        pose = robot.home_pose + offset
        shares = np.array(function(pose, np.zeros(6))).reshape(len(chosen), -1)
        np.testing.assert_array_equal((np.abs(shares) <= 1).all(axis=1), sight.visible(pose)[chosen])
        lost += not sight.visible(pose)[chosen].all()
    assert 10 < lost < 90


def test_sensor_that_does_not_see_the_platform_is_named(robot):
    with pytest.raises(TrajectoryError, match=r"visibility: both cameras can look for \d stickers of plane [ABC]"):
        MotionConstraints(robot, SCENARIO, narrowed(sight_lines("ctrack780"), 12.0))
