"""The experiment with images in the loop: what is recorded, lost and refused, and the sensor's
timing in it. That images decide the pose is proved in tests/cmmsim/test_measuring.py."""

import json

import numpy as np
import pytest
import xarray as xr

import cmmsim
from cmmsim.imaging.scene_bodies import PlacedBodies
from cmmsim.measuring.measurement import lost_measurement
from dynamics.closed_loop import (
    simulate_servo,
)
from dynamics.errors import SimulationError
from identify.errors import RecordError, TrajectoryError
from identify.estimation.explanation import SUSPICIOUS
from identify.estimation.identification import identify
from identify.experiment.joint_instruments import measure_joints
from identify.experiment.leg_bodies import robot_meshes, robot_transforms
from identify.experiment.run import run_plant
from identify.experiment.truth import check_truth, read_truth, true_poses
from identify.progress import SilentProgress
from identify.record.recording import poses
from identify.scenario import scenario_from_toml
from identify.setup import Setup, run_experiment, unseen_errors
from identify.studies.rows.row_sensor import DrawnSensor
from identify.trajectory import random_trajectory
from tests.identify import synthetic
from tests.identify.synthetic import (
    PERFECT,
    SIGMA,
    build_plant,
    quick,
    rss6,
    side_of,
    trajectory,
    truth,
)

SHORT = {"renderer": "analytic", "excitation.duration_s": 1.0, "excitation.candidates": 2}


class Told:
    """A sensor that keeps what it is told, and answers as another does; in some frames a shutter is
    closed.
    """

    def __init__(self, sensor, closed=()):
        self.sensor, self.closed, self.seeds, self.poses, self.rates = sensor, closed, [], [], []

    def start_run(self, seed):
        self.seeds.append(seed)
        self.sensor.start_run(seed)

    def measure(self, pose, obstacles=None, pose_rate=None):
        self.poses.append(pose)
        self.rates.append(pose_rate)
        measured = self.sensor.measure(pose, obstacles, pose_rate)
        return (
            lost_measurement("shutter closed") if len(self.rates) - 1 in self.closed else measured
        )


@pytest.fixture(scope="module")
def sensor():
    return Setup(quick(**SHORT)).sensor_plan.taught(rss6(), 0, SilentProgress())


def test_rods_join_the_robots_joints():
    """Every crank starts at its base joint and ends where its link starts; every link ends at its
    platform joint.
    """
    robot = rss6()
    pose = robot.home_pose + np.array([0.004, -0.006, 0.005, 0.02, -0.01, 0.03])
    transforms = robot_transforms(robot, pose)
    platform = cmmsim.pose_to_transform(pose)
    for leg in range(6):
        crank, link, own = (
            transforms[f"crank{leg + 1}"],
            transforms[f"link{leg + 1}"],
            robot.geometry.legs[leg],
        )
        tip = crank[:3, 3] + own.crank_length * crank[:3, 2]
        end = link[:3, 3] + own.link_length * link[:3, 2]
        joint = platform[:3, :3] @ robot.geometry.platform_joints[leg] + platform[:3, 3]
        assert np.allclose(crank[:3, 3], robot.geometry.base_joints[leg], atol=1e-12)
        assert np.allclose(tip, link[:3, 3], atol=1e-12)
        assert np.allclose(end, joint, atol=1e-12)


@pytest.mark.slow
def test_legs_that_are_placed_together_are_those_placed_one_by_one(sensor):
    """Also in another order, and where one of them is missing; what is no place is refused by its
    name.
    """
    robot = rss6()
    pose = robot.home_pose + np.array([0.004, -0.006, 0.005, 0.02, -0.01, 0.03])
    together, found = robot_transforms(robot, pose), []
    assert together.names == tuple(robot_meshes(robot))
    assert (len(together), "crank7" in together) == (12, False)
    for placed in (together, dict(together), dict(reversed([*together.items()]))):
        sensor.start_run(3)
        found.append(sensor.measure(pose, placed))
    for other in found[1:]:
        np.testing.assert_array_equal(other.pose, found[0].pose)
        np.testing.assert_array_equal(other.target_ids, found[0].target_ids)
    torn = PlacedBodies(together.names, together.together + np.eye(4)[3])
    for wrong in (torn, PlacedBodies(together.names, 1.01 * together.together)):
        with pytest.raises(cmmsim.ShapeError, match="obstacle 'crank1'"):
            sensor.measure(pose, wrong)
    with pytest.raises(cmmsim.UnknownBodyError, match="crank9"):
        sensor.measure(pose, PlacedBodies(("crank9",), together.together[:1]))


@pytest.mark.slow
def test_a_lost_frame_is_counted_holds_the_command_and_does_not_end_the_run(sensor):
    """Nothing is seen for five frames, then the platform is found again; the sensor is told how
    fast it moves.
    """
    told = Told(sensor, closed=range(10, 15))
    experiment = run_plant(build_plant(quick(**SHORT), rss6()), told, trajectory(3), 0.5, 7, 0)
    record = experiment.record
    assert len(told.seeds) == 1
    measured = record["measured_ok"].values == 1
    assert list(np.flatnonzero(~measured)) == [10, 11, 12, 13, 14]
    assert np.all(np.linalg.eigvalsh(record["measured_covariance"].values[measured]) > 0)
    assert np.isnan(poses(record, "measured")[10:15]).all()
    commands = record["command"].values
    assert np.array_equal(commands[10:15], np.tile(commands[9], (5, 1)))
    assert "frame 10" in record.attrs["lost_frames"]
    steps = np.diff(true_poses(experiment.truth), axis=0) * 60.0
    middle = (np.array(told.rates)[1:] + np.array(told.rates)[:-1]) / 2
    assert np.abs(middle - steps).max() < 0.05 * np.abs(steps).max()
    wild = random_trajectory(np.random.default_rng(0), rss6().geometry.chart, 0.1, 5, 0.02, 0.08)
    with pytest.raises(TrajectoryError, match=r"crank \d|leg \d"):
        run_plant(build_plant(quick(), rss6()), told, wild, 10.0, 0, 0)
    assert len(told.seeds) == 1, "refused before the run"


@pytest.mark.slow
def test_run_experiment_returns_what_it_writes_with_the_noise_of_its_seed(tmp_path, sensor):
    record = run_experiment(quick(**SHORT), seed=2, path=tmp_path / "experiment.nc")
    with xr.open_dataset(tmp_path / "experiment.nc") as stored:
        assert np.array_equal(stored["measured_position"], record["measured_position"])
        assert stored["measured_position"].attrs["units"] == "m"
    assert true_poses(read_truth(record.attrs["path"])).shape == (60, 6)
    assert "truth" not in " ".join(map(str, record.data_vars))
    assert abs(record.attrs["scale_anchor_value"] - 23.5) < 5 * record.attrs["scale_anchor_std"]
    assert record.attrs["scale_anchor_value"] != 23.5
    assert json.loads(record.attrs["robot_geometry"])["leg1.crank_length"] == 0.06
    plant = build_plant(quick(**SHORT), rss6())
    runs = [run_plant(plant, sensor, trajectory(3), 0.1, seed, 0).record for seed in (0, 0, 5)]
    assert np.array_equal(poses(runs[0], "measured"), poses(runs[1], "measured"))
    assert not np.array_equal(poses(runs[0], "measured"), poses(runs[2], "measured"))


def test_the_sensor_gets_the_scenarios_timing_and_latencies_jitter_as_it_says(sensor):
    """A jitter of none draws nothing; the model knows the mean."""

    def late(jitter_s, **more):
        return quick(**{"timing.latency_s": 0.01, "timing.latency_jitter_s": jitter_s} | more)

    def true(seed, jitter_s):
        eye = DrawnSensor(np.diag(SIGMA**2))
        return true_poses(
            run_plant(build_plant(late(jitter_s), rss6()), eye, trajectory(3), 0.5, seed, 0).truth
        )

    scenario = late(0.0, **{"timing.exposure_s": 0.004, "timing.dropout": 0.25})
    timing = Setup(scenario).sensor_plan.make(rss6(), 0, sensor.taught).timing
    assert (timing.frame_rate, timing.exposure, timing.dropout, timing.latency) == (
        60.0,
        0.004,
        0.25,
        0.01,
    )
    assert scenario.timing.drawn_latencies(400, np.random.default_rng(0)) is None
    assert late(0.002).timing.drawn_latencies(400, np.random.default_rng(0)).std() == pytest.approx(
        0.002, rel=0.15
    )
    assert side_of(late(0.002)).settings.timing.latency_s == 0.01
    jittered = true(0, 0.005)
    assert np.array_equal(jittered, true(0, 0.005))
    assert 1e-7 < np.abs(jittered - true(0, 0.0)).max() < 1e-3
    assert not np.array_equal(jittered, true(1, 0.005))


# Plants that no model of the estimator can be: what the switches do, and that the residuals tell.
# The dynamics of these plants are proved in tests/dynamics/test_elastic_joints.py and
# test_closed_loop.py.

ELASTIC = {"plant.joint_stiffness_N_m_rad": 1000.0}
MISPLACED = {"plant.geometry_error_m": 1e-4}
STRIBECK = {
    "plant.friction": "stribeck",
    "plant.static_ratio": 1.3,
    "plant.stribeck_velocity_rad_s": 0.05,
}


@pytest.mark.slow
def test_the_model_knows_of_no_switch_and_without_one_the_plant_is_the_nominal_robot_bit_by_bit():
    switched, plain = quick(**ELASTIC, **MISPLACED, **STRIBECK), quick()
    assert side_of(switched).settings == side_of(quick()).settings
    assert build_plant(switched).settings.elasticity.stiffness == 1000.0
    text = switched.to_toml()
    assert scenario_from_toml(text) == switched
    for line in (
        "joint_stiffness_N_m_rad = 1000.0",
        "[N m/rad]",
        "geometry_error_m = 0.0001",
        "motor_inertia_kg_m2",
    ):
        assert line in text
    assert "\njoint_stiffness" not in quick().to_toml()
    with pytest.raises(SimulationError, match="of crank2 including its motor"):
        build_plant(quick(**ELASTIC, **{"plant.motor_inertia_kg_m2": 1e-3}), rss6()).check()
    plant, reference = (
        build_plant(plain, rss6()),
        trajectory(0).reference(plain.timing.frame_times(0.5)),
    )
    assert plant.robot is rss6()
    ours, nominal = plant.run(reference), simulate_servo(rss6(), truth(), reference, plant.settings)
    assert {"base_joint_error", "motor_angle"}.isdisjoint(plant.truth(ours))
    np.testing.assert_array_equal(ours.pose, nominal.pose)
    np.testing.assert_array_equal(ours.command, nominal.command)


@pytest.mark.thorough
def test_the_truth_holds_true_poses_motors_joint_errors_and_switches_and_the_encoders_read_the_motors():
    """Crank angles are those of the poses that the sensor was shown; motors are ahead by torque
    over stiffness.
    """
    scenario = quick(**ELASTIC, **MISPLACED)
    told, plant = Told(DrawnSensor(1e-24 * np.eye(6))), build_plant(scenario, rss6())
    run, robot = run_plant(plant, told, trajectory(3), 0.5, 0, 0), plant.robot
    np.testing.assert_array_equal(true_poses(run.truth), told.poses)
    cranks, motors = run.truth["joint_angle"].values, run.truth["motor_angle"].values
    np.testing.assert_allclose(cranks, robot.inverse_kinematics(np.array(told.poses)), atol=1e-15)
    holding = robot.static_torque(told.poses[0], truth()[:64])
    np.testing.assert_allclose((motors - cranks)[0], holding / 1000.0, rtol=1e-9)
    assert run.truth.attrs["plant_joint_stiffness_N_m_rad"] == 1000.0
    errors = robot.geometry.base_joints - rss6().geometry.base_joints
    np.testing.assert_array_equal(run.truth["base_joint_error"].values, errors)
    assert 0.5e-4 < errors.std() < 2e-4
    assert (
        build_plant(quick(**MISPLACED, **{"plant.geometry_seed": 1})).robot.geometry
        != robot.geometry
    )
    channels = measure_joints(
        run.record, run.truth, scenario.timing, PERFECT, np.random.default_rng(0)
    )
    np.testing.assert_array_equal(channels["joint_angle"].values, motors)
    with pytest.raises(RecordError, match="motor_angle are not finite"):
        check_truth(run.truth.assign(motor_angle=run.truth["motor_angle"] * np.nan), "broken truth")


def test_unseen_trajectories_are_run_by_the_elastic_plant():
    """With the true parameters a rigid model misses it, and not the rigid plant with the same
    friction law.
    """
    short = {"validation.duration_s": 1.0, "validation.count": 1, "excitation.candidates": 2}
    rigid, elastic = (
        unseen_errors(truth(), rss6(), quick(**short, **switch)) for switch in ({}, ELASTIC)
    )
    assert np.abs(rigid).max() < 1e-8
    assert np.abs(elastic).max() > 1e-6


def _identified(**switch):
    """10 s with white noise of 5 um and 30 urad, identified with the commands that were logged."""
    scenario = quick(**{"identification.method": "command_driven"} | switch)
    return identify(synthetic.run_plant(scenario, seed=0)[0], rss6(), scenario)


@pytest.mark.parametrize(
    "switch",
    [
        pytest.param(ELASTIC, id="elastic joints", marks=pytest.mark.slow),
        pytest.param(MISPLACED, id="joints off by 0.1 mm", marks=pytest.mark.slow),
        pytest.param(
            MISPLACED | {"plant.geometry_seed": 1}, id="another robot", marks=pytest.mark.thorough
        ),
    ],
)
def test_the_residuals_say_that_the_model_is_wrong(switch):
    result = _identified(**switch)
    assert result.whiteness.p_value < SUSPICIOUS
    assert result.noise_ratio > 1.05
    assert any("are correlated from frame to frame" in said for said in result.warnings)


@pytest.mark.thorough
def test_the_residuals_of_elastic_joints_that_the_closed_loop_hides_are_those_of_the_logged_commands():
    """The closed loop explains the record, with wrong parameters; the model driven by the commands
    does not.
    """
    hidden = _identified(**ELASTIC, **{"identification.method": "closed_loop"})
    assert hidden.noise_ratio < 1.2
    assert not hidden.identifiable.any()
    assert any("driven by the logged commands, the model" in said for said in hidden.warnings)


@pytest.mark.thorough
def test_intervals_hold_though_joints_are_off_by_a_third_of_a_millimetre():
    """The misfit is as large as the noise; intervals of white noise would miss by 4.5 standard
    deviations.
    """
    result = _identified(**MISPLACED | {"plant.geometry_error_m": 3e-4})
    assert 1.5 < result.noise_ratio < 3
    known = result.identifiable
    errors = ((result.estimate - truth()) / result.std)[known]
    assert known.sum() >= 20
    assert np.sqrt(np.mean(errors**2)) < 1.3
    assert np.abs(errors).max() < 3
