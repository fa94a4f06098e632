"""Zeros of the joints, and scale and steps of the commands: in the plant, and as errors that the
estimator knows to a standard deviation.
"""

from dataclasses import replace

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.closed_loop import (
    Drives,
    FrictionLaw,
    LoopSettings,
    differentiate_servo,
    simulate_commands,
    simulate_servo,
)
from dynamics.errors import SimulationError
from identify.diagnosis.diagnose import diagnosis_from
from identify.errors import ScenarioError
from identify.estimation.identification import identify
from identify.experiment.joint_instruments import measure_joints
from identify.experiment.true_robot import true_deviations, true_zeros
from identify.model.common_error_prior import lowest_errors, settings_with_errors
from identify.record.known_geometry import KnownGeometry
from identify.record.stored_common_errors import (
    LATENCY,
    SCALE,
    STATIC_RATIO,
    STRIBECK_VELOCITY,
    kind_of,
)
from tests.identify.synthetic import (
    PERFECT,
    build_plant,
    problem_of,
    quick,
    rss6,
    run_plant,
    side_of,
    trajectory,
)

ZEROS = [3e-4, -5e-4, 2e-4, 0.0, 4e-4, -1e-4]
FRICTION_AND_GAINS = slice(52, None)


def settings_of(**drives) -> LoopSettings:
    settings = build_plant(quick(), rss6()).settings
    return replace(settings, drives=Drives(**drives))


def test_a_drive_with_another_zero_and_scale_moves_as_under_the_commands_that_it_receives():
    """The commands s U + z given to a right drive are U given to a wrong one."""
    robot, zeros = rss6(), np.array(ZEROS)
    parameters = robot.parameter_sets["truth"].vector
    _, run = run_plant(quick(), 1, duration_s=2.0)
    reference = some_reference()
    wrong = settings_of(command_scale=1.002, joint_zeros=tuple(ZEROS))
    found = simulate_commands(robot, parameters, reference, wrong, run.command)
    received = 1.002 * run.command + zeros
    right = simulate_commands(robot, parameters, reference, settings_of(), received)
    np.testing.assert_allclose(found.pose, right.pose, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.command, run.command)


def some_reference():
    return trajectory(0).reference(quick().timing.frame_times(2.0))


def test_a_servo_takes_up_the_zeros_and_logs_what_it_sent():
    """The motion is almost that of right zeros, and the log differs by them.

    The integral of the servo is multiplied by the Jacobian, which changes during the motion. Under
    the same commands, zeros of this size move the platform by some 30 um.
    """
    plain, right = run_plant(quick(), 1, sigma=np.zeros(6), duration_s=2.0)
    wrong = quick(**{"plant.joint_zero_error_rad": ZEROS})
    other, found = run_plant(wrong, 1, sigma=np.zeros(6), duration_s=2.0)
    np.testing.assert_allclose(found.pose, right.pose, rtol=0, atol=2e-6)
    apart = plain["command"].values - other["command"].values
    np.testing.assert_allclose(apart, np.tile(ZEROS, (len(apart), 1)), rtol=0, atol=2e-5)


def test_commands_are_rounded_to_their_steps():
    robot, step = rss6(), 1e-3
    parameters = robot.parameter_sets["truth"].vector
    _, run = run_plant(quick(), 1, duration_s=1.0)
    reference = replace_frames(some_reference(), len(run.command))
    found = simulate_commands(
        robot, parameters, reference, settings_of(command_step=step), run.command
    )
    rounded = step * np.round(run.command / step)
    right = simulate_commands(robot, parameters, reference, settings_of(), rounded)
    np.testing.assert_allclose(found.pose, right.pose, rtol=0, atol=1e-12)
    plant = build_plant(quick(**{"plant.command_quantum_rad": step}), robot)
    assert plant.settings.drives.command_step == step


def replace_frames(reference, frames):
    return type(reference)(reference.poses[:frames], reference.rates[:frames])


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_sensitivities_of_the_servo_follow_the_scale(compiled):
    """Against differences of runs, compiled and plain."""
    robot = rss6()
    parameters = robot.parameter_sets["truth"].vector
    reference = replace_frames(some_reference(), 8 if not compiled else 60)
    settings = settings_of(command_scale=1.1, joint_zeros=tuple(ZEROS))
    run = differentiate_servo(robot, parameters, reference, settings, compiled=compiled)
    index = robot.layout.joint_pid.start
    step = 1e-5 * parameters[index]
    ends = []
    for sign in (1, -1):
        moved = parameters.copy()
        moved[index] += sign * step
        ends.append(simulate_servo(robot, moved, reference, settings, compiled=compiled).pose)
    numeric = (ends[0] - ends[1]) / (2 * step)
    found = run.pose_sensitivity[:, :, index]
    np.testing.assert_allclose(found, numeric, rtol=0, atol=1e-4 * np.abs(numeric).max())


def test_drawn_zeros_are_those_of_the_seed_of_the_geometry():
    scenario = quick(**{"plant.joint_zero_error_rad": 5e-4, "plant.geometry_seed": 3})
    first, again = (true_zeros(rss6(), scenario.plant) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = quick(**{"plant.joint_zero_error_rad": 5e-4, "plant.geometry_seed": 4})
    assert (true_zeros(rss6(), other.plant) != first).all()
    many = [
        true_zeros(
            rss6(),
            quick(**{"plant.joint_zero_error_rad": 5e-4, "plant.geometry_seed": seed}).plant,
        )
        for seed in range(60)
    ]
    assert np.std(many) == pytest.approx(5e-4, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param("closed_loop", marks=pytest.mark.thorough), "command_driven"]
)
def test_zeros_and_scale_with_a_prior_are_estimated_and_intervals_hold(method):
    """Beside friction and gains, which are off by many deviations without the prior."""
    true = {"plant.joint_zero_error_rad": ZEROS, "plant.command_scale": 1.0015}
    stated = {"model.joint_zero_std_rad": 5e-4, "model.command_scale_std": 1e-3}
    scenario = quick(**true, **stated, **{"identification.method": method})
    values = build_plant(scenario, rss6()).parameters
    record, _ = run_plant(scenario, seed=1)
    result = identify(record, rss6(), scenario)
    assert result.explained
    shares = ((result.estimate - values) / result.std)[FRICTION_AND_GAINS]
    assert np.abs(shares).max() < 4
    errors = result.common_errors
    assert errors.names == (*(f"zeros.joint{k}_rad" for k in range(1, 7)), SCALE)
    if method == "command_driven":
        off = np.array([*ZEROS, 1.5e-3]) - errors.estimate
        assert np.abs(off / errors.std).max() < 4
        assert (errors.std[:6] < 0.3 * 5e-4).all()
    assert set(result.common_share) == {"zeros", "scale"}


@pytest.mark.slow
def test_a_model_with_the_prior_explains_what_one_without_is_diagnosed_for():
    """The remedy of the diagnosis is the setting that mends it."""
    true = quick(**{"plant.joint_zero_error_rad": [0, 3e-4, 0, 0, 0, 0]})
    record, _ = run_plant(true, seed=2, duration_s=5.0)
    values = rss6().parameter_sets["truth"].vector
    found = diagnosis_from(problem_of([record], quick()), values)
    first = found.findings[0]
    assert first.name == "zero of joint 2"
    assert first.remedies[0].startswith("--set model.joint_zero_std_rad=0.001; ")
    assert abs(first.sizes[0].value - 3e-4) < 3 * first.sizes[0].std
    mended = quick(**{"model.joint_zero_std_rad": 1e-3})
    assert not diagnosis_from(problem_of([record], mended), values).findings


@pytest.mark.slow
def test_the_scale_of_the_commands_is_diagnosed_with_its_setting():
    record, _ = run_plant(quick(**{"plant.command_scale": 1.0017}), seed=3, duration_s=5.0)
    values = rss6().parameter_sets["truth"].vector
    first = diagnosis_from(problem_of([record], quick()), values).findings[0]
    assert first.name == "scale of the commands"
    assert first.remedies[0].startswith("--set model.command_scale_std=0.01, ")
    assert abs(first.sizes[0].value - 1.7e-3) < 3 * first.sizes[0].std


def test_the_errors_in_the_loop_are_those_of_the_kinds_that_are_asked():
    stated = {"model.joint_zero_std_rad": 5e-4, "model.command_scale_std": 1e-3}
    record, _ = run_plant(quick(), 1, duration_s=5.0)
    every = problem_of([record], quick(**stated)).runs[0].common
    assert [kind_of(name) for name in every.all_names] == [*["zeros"] * 6, "scale"]
    some = quick(**stated, **{"identification.nuisances": ["scale"]})
    assert problem_of([record], some).runs[0].common.loop_std == {SCALE: 1e-3}
    assert problem_of([record], quick()).runs[0].common.loop_std == {}


def test_a_loop_without_errors_is_the_loop():
    settings = side_of(quick()).settings
    assert settings_with_errors(settings, {LATENCY: 0.01}) is settings
    law = FrictionLaw("stribeck", static_ratio=1.2, stribeck_velocity=0.05)
    stds = {LATENCY: 0.002, SCALE: 0.1, STATIC_RATIO: 0.1, f"{STRIBECK_VELOCITY}_rad/s": 0.03}
    assert np.allclose(lowest_errors(stds, 0.01, law), [-5.0, -9.0, -2.0, -1.5])


def test_encoders_read_the_zero_too_little_and_torques_stay():
    record, run = run_plant(quick(**{"plant.joint_zero_error_rad": ZEROS}), 1, duration_s=2.0)
    truth = build_plant(quick(**{"plant.joint_zero_error_rad": ZEROS}), rss6()).truth(run)
    np.testing.assert_array_equal(truth["joint_zero_error"].values, ZEROS)
    found = measure_joints(record, truth, quick().timing, PERFECT, np.random.default_rng(0))
    apart = truth["joint_angle"].values - found["joint_angle"].values
    np.testing.assert_allclose(apart, np.tile(ZEROS, (len(apart), 1)), rtol=0, atol=1e-12)
    right, other = run_plant(quick(), 1, duration_s=2.0)
    plain = measure_joints(
        right,
        build_plant(quick(), rss6()).truth(other),
        quick().timing,
        PERFECT,
        np.random.default_rng(0),
    )
    np.testing.assert_allclose(
        found["joint_torque"].values, plain["joint_torque"].values, rtol=0, atol=2e-4
    )


def test_sliding_actuators_have_keys_of_their_own():
    ups6 = load_robot("ups6")
    scenario = quick(**{"plant.joint_zero_error_m": [1e-5] * 6, "plant.command_quantum_m": 1e-6})
    drives = build_plant(scenario, ups6).settings.drives
    assert (drives.joint_zeros, drives.command_step) == ((1e-5,) * 6, 1e-6)
    with pytest.raises(ScenarioError, match=r"plant\.joint_zero_error_rad = \[.* slide: set"):
        build_plant(quick(**{"plant.joint_zero_error_rad": [1e-5] * 6}), ups6)
    record, _ = run_plant(quick(), 1, duration_s=5.0, robot=ups6)
    common = problem_of([record], quick(**{"model.joint_zero_std_m": 1e-5}), ups6).runs[0].common
    assert next(iter(common.loop_std)) == "zeros.joint1_m"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"plant.joint_zero_error_rad": -1e-3}, r"joint_zero_error_rad.*-0\.001 is not from 0"),
        (
            {"plant.joint_zero_error_rad": [0.2] * 6},
            r"joint_zero_error_rad.*0\.2 is not from -0\.1",
        ),
        ({"plant.command_scale": 0.0}, r"plant\.command_scale = 0"),
        ({"plant.command_quantum_rad": 0.0}, r"plant\.command_quantum_rad = 0"),
        ({"model.joint_zero_std_rad": -1.0}, r"model\.joint_zero_std_rad = -1"),
        ({"model.command_scale_std": 0.5}, r"model\.command_scale_std = 0\.5"),
        (
            {"model.joint_zero_std_rad": 1e-3, "geometry.known": "calibrated"},
            r"joint_zero_std_rad = 0\.001 with geometry\.known = 'calibrated'.* only one",
        ),
    ],
)
def test_bad_values_are_refused(changes, said):
    with pytest.raises(ScenarioError, match=said):
        quick(**changes)


@pytest.mark.thorough
def test_the_zeros_of_a_plant_whose_geometry_is_calibrated_are_in_its_geometry():
    """Where the calibration finds them, and not a second time in the drives."""
    asked = {"plant.joint_zero_error_rad": ZEROS, "geometry.encoder_offset_rad": 0.0}
    scenario = quick(**asked, **{"geometry.known": "calibrated"})
    robot = rss6()
    found = true_deviations(robot, scenario.plant, scenario.geometry, 0)
    shifted = robot.geometry.shifted(np.array(ZEROS)).deviations_from(robot.geometry)
    np.testing.assert_allclose(found, shifted, rtol=0, atol=1e-12)
    known = KnownGeometry(robot, np.eye(len(found)) * 1e-12)
    plant = build_plant(scenario, robot, known=known)
    assert plant.settings.drives.joint_zeros == ()
    angles = plant.robot.inverse_kinematics(robot.home_pose)
    np.testing.assert_allclose(robot.inverse_kinematics(robot.home_pose) - angles, ZEROS, atol=1e-9)


def test_zeros_of_another_number_of_joints_are_refused():
    scenario = quick(**{"plant.joint_zero_error_rad": [1e-4, 1e-4]})
    with pytest.raises(ScenarioError, match=r"joint_zero_error_rad has 2 values, but rss6 has 6"):
        build_plant(scenario, rss6())
    parameters = rss6().parameter_sets["truth"].vector
    with pytest.raises(SimulationError, match="zeros of 2 joints, but the robot has 6"):
        simulate_commands(
            rss6(),
            parameters,
            some_reference(),
            settings_of(joint_zeros=(0.0, 1e-4)),
            np.zeros((120, 6)),
        )
    with pytest.raises(SimulationError, match="zero of joint 2 is nan"):
        Drives(joint_zeros=(0.0, np.nan))
    with pytest.raises(SimulationError, match=r"scale of the commands is 0\.0"):
        Drives(command_scale=0.0)
