"""Limits of the range of commands that the drives of a plant take."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics.closed_loop import Drives, differentiate_servo, simulate_commands, simulate_servo
from dynamics.errors import SimulationError
from identify.errors import ScenarioError
from identify.experiment.run import excitation_run
from identify.experiment.truth import true_poses
from identify.studies.rows.row_sensor import DrawnSensor
from tests.identify.synthetic import SIGMA, build_plant, quick, rss6, run_plant, trajectory


def limits_of(command):
    """Limits that a motion meets and in which it begins: a fifth of its commands is beyond."""
    low, high = np.quantile(command, [0.1, 0.9])
    first = command[0]
    return [float(min(low, first.min() - 1e-3)), float(max(high, first.max() + 1e-3))]


@pytest.mark.parametrize(
    "law", ["servo", pytest.param("feedforward", marks=pytest.mark.slow), "cascade"]
)
def test_a_plant_with_limits_moves_as_a_plain_one_under_its_log_cut_at_them(law):
    """Under the servo, a law of its own and other drives: the log has what was sent."""
    changes = {"plant.drive": "cascade"} if law == "cascade" else {}
    changes |= {"excitation.law": law} if law == "feedforward" else {}
    changes |= {"excitation.duration_s": 2.0}

    def record_of(scenario):
        plant = build_plant(scenario, rss6())
        sensor = DrawnSensor(np.diag(SIGMA**2))
        return plant, excitation_run(plant, sensor, trajectory(0), scenario.excitation, 1)

    _, free = record_of(quick(**changes))
    limits = limits_of(free.record["command"].values)
    plant, made = record_of(quick(**changes, **{"plant.command_limits_rad": limits}))
    sent = made.record["command"].values
    cut = np.clip(sent, *limits)
    assert 10 < (sent != cut).sum() < 0.5 * sent.size
    plain = replace(plant.settings, drives=replace(plant.settings.drives, command_limits=None))
    reference = trajectory(0).reference(quick().timing.frame_times(2.0))
    right = simulate_commands(plant.robot, plant.parameters, reference, plain, cut)
    np.testing.assert_allclose(true_poses(made.truth), right.pose, rtol=0, atol=1e-9)
    assert np.abs(true_poses(made.truth) - true_poses(free.truth)).max() > 1e-4


def test_sensitivities_of_the_servo_follow_commands_that_are_cut():
    """Against differences of runs, with scale and steps before and behind the limits."""
    robot = rss6()
    parameters = robot.parameter_sets["truth"].vector
    reference = trajectory(0).reference(quick().timing.frame_times(1.0))
    settings = build_plant(quick(), robot).settings
    free = simulate_servo(robot, parameters, reference, settings)
    drives = Drives(command_limits=tuple(limits_of(free.command)), command_scale=1.05)
    settings = replace(settings, drives=drives)
    run = differentiate_servo(robot, parameters, reference, settings)
    low, high = drives.command_limits
    assert ((run.command < low) | (run.command > high)).sum() > 10
    for index in (robot.layout.joint_pid.start, 58):
        step = 1e-5 * parameters[index]
        ends = [
            simulate_servo(
                robot, parameters + by * np.eye(len(parameters))[index], reference, settings
            ).pose
            for by in (step, -step)
        ]
        numeric = (ends[0] - ends[1]) / (2 * step)
        found = run.pose_sensitivity[:, :, index]
        np.testing.assert_allclose(found, numeric, rtol=0, atol=1e-3 * np.abs(numeric).max())


def test_drives_round_commands_before_they_cut_them_and_torques_have_no_limits():
    received = Drives(command_limits=(-0.1, 0.2)).interface(6)
    assert (received["command_low"], received["command_high"]) == (-0.1, 0.2)
    received = Drives(torques=True, command_limits=(-0.1, 0.2)).interface(6)
    assert (received["command_low"], received["command_high"]) == (-np.inf, np.inf)
    robot = rss6()
    parameters = robot.parameter_sets["truth"].vector
    _, run = run_plant(quick(), 1, duration_s=0.5)
    reference = trajectory(0).reference(quick().timing.frame_times(0.5))
    limits = tuple(limits_of(run.command))
    plain = build_plant(quick(), robot).settings
    both = replace(plain, drives=Drives(command_limits=limits, command_step=1e-3))
    found = simulate_commands(robot, parameters, reference, both, run.command)
    rounded = np.clip(1e-3 * np.round(run.command / 1e-3), *limits)
    right = simulate_commands(robot, parameters, reference, plain, rounded)
    np.testing.assert_allclose(found.pose, right.pose, rtol=0, atol=1e-12)


def test_limits_that_no_robot_can_have_are_refused_in_one_line():
    with pytest.raises(ScenarioError, match=r"command_limits_rad.*lowest command 0\.2 is not"):
        quick(**{"plant.command_limits_rad": [0.2, 0.1]})
    with pytest.raises(ScenarioError, match=r"command_limits_rad"):
        quick(**{"plant.command_limits_rad": [0.2]})
    with pytest.raises(ScenarioError, match=r"for actuators that slide.*set command_limits_rad"):
        build_plant(quick(**{"plant.command_limits_m": [-0.1, 0.1]}), rss6())
    with pytest.raises(SimulationError, match=r"highest command is 0\.1.*0\.2"):
        Drives(command_limits=(0.2, 0.1))
    narrow = quick(**{"plant.command_limits_rad": [5.0, 6.0]})
    with pytest.raises(SimulationError, match=r"joint \d needs the command .* from 5 to 6"):
        run_plant(narrow, 1, duration_s=0.5)
