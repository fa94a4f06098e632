"""Plants that no model of the estimator can be: what the switches do, and that the residuals tell.

The dynamics of these plants are proved in tests/dynamics/test_elastic_joints.py and test_geometry_error.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from cmmsim.pose_estimation.estimator import lost_measurement
from dynamics.closed_loop import simulate
from dynamics.errors import SimulationError
from identify.errors import RecordError
from identify.estimation.explanation import SUSPICIOUS
from identify.estimation.identification import identify
from identify.experiment import run as experiment
from identify.experiment.joint_instruments import JointInstruments, measure_joints
from identify.experiment.plant import build_plant
from identify.experiment.truth import check_truth, true_poses
from identify.loop_parameters import model_settings
from identify.scenario import scenario_from_toml
from identify.validation.unseen import unseen_errors
from tests.identify.synthetic import quick, rss6, run_plant, trajectory, truth

ELASTIC = {"plant.joint_stiffness_N_m_rad": 1000.0}
MISPLACED = {"plant.geometry_error_m": 1e-4}
STRIBECK = {"plant.friction": "stribeck", "plant.static_ratio": 1.3, "plant.stribeck_velocity_rad_s": 0.05}


class PerfectSensor:
    """Measures the pose that it is shown."""

    def __init__(self):
        self.poses = []

    def start_run(self, seed):
        self.poses.clear()

    def measure(self, pose, obstacles, pose_rate):
        self.poses.append(pose)
        return replace(lost_measurement("none"), pose=pose, covariance=1e-12 * np.eye(6), ok=True, reason="")


def _short(**overrides):
    return quick(**{"excitation.duration_s": 0.5} | overrides)


def test_without_a_switch_the_plant_is_the_nominal_robot_bit_by_bit():
    scenario = _short()
    plant = build_plant(scenario, rss6())
    assert plant.robot is rss6()
    reference = trajectory(0).reference(scenario.timing.frame_times(0.5))
    ours = plant.run(reference)
    plain = simulate(rss6(), truth(), reference, plant.settings)
    np.testing.assert_array_equal(ours.pose, plain.pose)
    np.testing.assert_array_equal(ours.command, plain.command)


def test_the_model_knows_of_none_of_the_switches():
    switched = quick(**ELASTIC, **MISPLACED, **STRIBECK)
    assert model_settings(switched) == model_settings(quick())
    assert build_plant(switched).settings.elasticity.stiffness == 1000.0


def test_the_switches_stand_in_the_resolved_scenario_with_their_units():
    switched = quick(**ELASTIC, **MISPLACED)
    text = switched.to_toml()
    assert scenario_from_toml(text) == switched
    for line in ("joint_stiffness_N_m_rad = 1000.0", "[N m/rad]", "geometry_error_m = 0.0001", "motor_inertia_kg_m2"):
        assert line in text
    assert "joint_stiffness" not in quick().to_toml()


def test_motors_heavier_than_their_cranks_are_refused_before_a_run():
    with pytest.raises(SimulationError, match="of crank 2 about its axis"):
        build_plant(quick(**ELASTIC, **{"plant.motor_inertia_kg_m2": 1e-3}), rss6()).check()


def test_the_truth_holds_true_poses_motors_and_switches_and_the_encoders_read_the_motors():
    """Crank angles are those of the poses that the sensor was shown; motors are ahead by torque over stiffness."""
    scenario, sensor = _short(**ELASTIC), PerfectSensor()
    run = experiment.run_plant(build_plant(scenario, rss6()), sensor, trajectory(3), 0.5, 0, 0)
    np.testing.assert_array_equal(true_poses(run.truth), sensor.poses)
    cranks, motors = run.truth["joint_angle"].values, run.truth["motor_angle"].values
    np.testing.assert_allclose(cranks, rss6().inverse_kinematics(np.array(sensor.poses)), atol=1e-15)
    holding = rss6().static_torque(sensor.poses[0], truth()[:64])
    np.testing.assert_allclose((motors - cranks)[0], holding / 1000.0, rtol=1e-9)
    assert run.truth.attrs["plant_joint_stiffness_N_m_rad"] == 1000.0
    assert "base_joint_error" not in run.truth
    perfect = JointInstruments(0.0, 0.0, 0.0)
    channels = measure_joints(run.record, run.truth, scenario.timing, perfect, np.random.default_rng(0))
    np.testing.assert_array_equal(channels["joint_angle"].values, motors)
    with pytest.raises(RecordError, match="motor_angle are not finite"):
        check_truth(run.truth.assign(motor_angle=run.truth["motor_angle"] * np.nan), "broken truth")


def test_unseen_trajectories_are_run_by_the_elastic_plant():
    """With the true parameters a rigid model misses it, and not the rigid plant with the same friction law."""
    short = {"validation.duration_s": 1.0, "validation.count": 1, "excitation.candidates": 2}
    rigid, elastic = (unseen_errors(truth(), rss6(), quick(**short, **switch)) for switch in ({}, ELASTIC))
    assert np.abs(rigid).max() < 1e-8
    assert np.abs(elastic).max() > 1e-6


@pytest.mark.slow
def test_the_truth_holds_the_joint_errors_of_the_plant():
    scenario = _short(**MISPLACED)
    sensor = PerfectSensor()
    run = experiment.run_plant(build_plant(scenario, rss6()), sensor, trajectory(3), 0.5, 0, 0)
    plant = build_plant(scenario, rss6()).robot
    errors = plant.geometry.base_joints - rss6().geometry.base_joints
    np.testing.assert_array_equal(run.truth["base_joint_error"].values, errors)
    assert 0.5e-4 < errors.std() < 2e-4
    np.testing.assert_array_equal(run.truth["joint_angle"].values, plant.inverse_kinematics(np.array(sensor.poses)))
    assert build_plant(scenario, rss6()).robot.geometry == plant.geometry
    other = scenario.with_overrides({"plant.geometry_seed": 1})
    assert build_plant(other, rss6()).robot.geometry != plant.geometry


def _identified(**switch):
    """10 s with white noise of 5 um and 30 urad, identified with the commands that were logged."""
    scenario = quick(**{"identification.method": "command_driven"} | switch)
    return identify(run_plant(scenario, seed=0)[0], rss6(), scenario)


@pytest.mark.parametrize(
    "switch",
    [
        pytest.param(STRIBECK, id="stribeck friction", marks=pytest.mark.slow),
        pytest.param(ELASTIC, id="elastic joints", marks=pytest.mark.slow),
        pytest.param(MISPLACED, id="joints off by 0.1 mm", marks=pytest.mark.slow),
        pytest.param(MISPLACED | {"plant.geometry_seed": 1}, id="another robot", marks=pytest.mark.thorough),
    ],
)
def test_the_residuals_say_that_the_model_is_wrong(switch):
    result = _identified(**switch)
    assert result.whiteness.p_value < SUSPICIOUS
    assert result.noise_ratio > 1.05
    assert any("not white" in said and "the model is wrong" in said for said in result.warnings)


@pytest.mark.slow
def test_elastic_joints_that_the_closed_loop_hides_leave_nothing_identified():
    """The closed loop explains the record, with wrong parameters; the model driven by the commands does not."""
    result = _identified(**ELASTIC, **{"identification.method": "closed_loop"})
    assert result.noise_ratio < 1.2
    assert not result.identifiable.any()
    assert any("driven by the logged commands, the model misses" in said for said in result.warnings)


@pytest.mark.thorough
def test_intervals_hold_though_joints_are_off_by_a_third_of_a_millimetre():
    """The misfit is as large as the noise; intervals of white noise would miss by 4.5 standard deviations."""
    result = _identified(**MISPLACED | {"plant.geometry_error_m": 3e-4})
    assert 1.5 < result.noise_ratio < 3
    known = result.identifiable
    errors = ((result.estimate - truth()) / result.std)[known]
    assert known.sum() >= 20
    assert np.sqrt(np.mean(errors**2)) < 1.3
    assert np.abs(errors).max() < 3


@pytest.mark.slow
def test_without_mismatch_they_do_not():
    result = _identified()
    assert result.whiteness.p_value > 0.01
    assert abs(result.noise_ratio - 1) < 0.1
    assert not any("wrong" in said for said in result.warnings)
