"""The experiment with images in the loop: what is recorded, lost and refused, and the sensor's timing in it.

That images decide the pose (one camera shifted by 0.1 px) is proved in tests/cmmsim/test_measuring.py.
"""

import json

import numpy as np
import pytest
import xarray as xr

import cmmsim
from cmmsim.pose_estimation.estimator import lost_measurement
from identify.errors import TrajectoryError
from identify.experiment.plant import build_plant
from identify.experiment.run import run_experiment, run_plant, taught_sensor
from identify.experiment.sensor_in_loop import SensorInLoop, make_sensor, robot_transforms
from identify.experiment.truth import read_truth, true_poses
from identify.loop_parameters import model_settings
from identify.progress import SilentProgress
from identify.record.recording import poses
from identify.studies.rows.sensor import DrawnSensor
from identify.trajectory import random_trajectory
from tests.identify.synthetic import SIGMA, quick, rss6, trajectory

SHORT = {"excitation.duration_s": 1.0, "excitation.candidates": 2}


class Told:
    """A sensor that keeps what it is told, and answers as another does; in some frames a shutter is closed."""

    def __init__(self, sensor, closed=()):
        self.sensor, self.closed, self.seeds, self.rates = sensor, closed, [], []

    def start_run(self, seed):
        self.seeds.append(seed)
        self.sensor.start_run(seed)

    def measure(self, pose, obstacles=None, pose_rate=None):
        self.rates.append(pose_rate)
        measured = self.sensor.measure(pose, obstacles, pose_rate)
        return lost_measurement("shutter closed") if len(self.rates) - 1 in self.closed else measured


@pytest.fixture(scope="module")
def sensor():
    return taught_sensor(quick(**SHORT), rss6(), 0, SilentProgress())


@pytest.fixture(scope="module")
def run_of(sensor):
    """A short run with images and a timing of its own, drawn analytically."""

    def make(path=None, duration_s=0.5, **timing):
        settings = {f"timing.{key}": value for key, value in timing.items()}
        scenario = quick(**SHORT, renderer="analytic", **settings)
        eye = make_sensor(scenario, rss6(), 0, sensor.taught)
        return run_plant(build_plant(scenario, rss6()), eye, path or trajectory(3), duration_s, 0, 0)

    return make


def test_rods_join_the_robots_joints():
    """Every crank starts at its base joint and ends where its link starts; every link ends at its platform joint."""
    robot = rss6()
    pose = robot.home_pose + np.array([0.004, -0.006, 0.005, 0.02, -0.01, 0.03])
    transforms = robot_transforms(robot, pose)
    platform = cmmsim.pose_to_transform(pose)
    for leg in range(6):
        crank, link = transforms[f"crank{leg + 1}"], transforms[f"link{leg + 1}"]
        tip = crank[:3, 3] + robot.geometry.crank_length * crank[:3, 2]
        end = link[:3, 3] + robot.geometry.link_length * link[:3, 2]
        joint = platform[:3, :3] @ robot.geometry.platform_joints[leg] + platform[:3, 3]
        assert np.allclose(crank[:3, 3], robot.geometry.base_joints[leg], atol=1e-12)
        assert np.allclose(tip, link[:3, 3], atol=1e-12)
        assert np.allclose(end, joint, atol=1e-12)


@pytest.mark.slow
@pytest.mark.rendering
def test_the_measured_pose_is_the_true_one_to_the_sensors_accuracy(sensor):
    experiment = run_plant(build_plant(quick(**SHORT), rss6()), sensor, trajectory(3), 1.0, 0, 0)
    errors = poses(experiment.record, "measured") - true_poses(experiment.truth)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert experiment.record["measured_ok"].values.all()
    assert np.all(rms[:3] < 20e-6), rms
    assert np.all(rms[3:] < 100e-6), rms
    assert np.all(rms > 1e-7), "a measurement without any error would be the truth itself"


@pytest.mark.slow
def test_the_same_seed_gives_the_same_record_and_another_does_not(sensor):
    plant = build_plant(quick(**SHORT), rss6())
    records = [run_plant(plant, sensor, trajectory(3), 0.1, seed, 0).record for seed in (4, 4, 5)]
    one, two, other = (poses(record, "measured") for record in records)
    assert np.array_equal(one, two)
    assert not np.array_equal(one, other)


def test_a_lost_frame_is_counted_holds_the_command_and_does_not_end_the_run(sensor):
    """Nothing is seen for five frames, then the platform is found again; the sensor is told how fast it moves."""
    told = Told(sensor, closed=range(10, 15))
    experiment = run_plant(build_plant(quick(**SHORT), rss6()), told, trajectory(3), 0.5, 0, 0)
    record = experiment.record
    assert list(np.flatnonzero(record["measured_ok"].values == 0)) == [10, 11, 12, 13, 14]
    assert np.isnan(poses(record, "measured")[10:15]).all()
    commands = record["command"].values
    assert np.array_equal(commands[10:15], np.tile(commands[9], (5, 1)))
    assert "frame 10" in record.attrs["lost_frames"]
    steps = np.diff(true_poses(experiment.truth), axis=0) * 60.0
    middle = (np.array(told.rates)[1:] + np.array(told.rates)[:-1]) / 2
    assert np.abs(middle - steps).max() < 0.05 * np.abs(steps).max()


@pytest.mark.slow
@pytest.mark.rendering
def test_run_experiment_returns_what_it_writes(tmp_path):
    record = run_experiment(quick(**SHORT), seed=2, path=tmp_path / "experiment.nc")
    with xr.open_dataset(tmp_path / "experiment.nc") as stored:
        assert np.array_equal(stored["measured_position"], record["measured_position"])
        assert stored["measured_position"].attrs["units"] == "m"
    truth = read_truth(record.attrs["path"])
    assert true_poses(truth).shape == (60, 6)
    assert "truth" not in " ".join(map(str, record.data_vars))
    assert abs(record.attrs["scale_anchor_value"] - 23.5) < 5 * record.attrs["scale_anchor_std"]
    assert record.attrs["scale_anchor_value"] != 23.5
    assert json.loads(record.attrs["robot_geometry"])["crank_length"] == 0.06


def test_a_trajectory_beyond_the_travel_is_refused_before_the_run():
    wild = random_trajectory(np.random.default_rng(0), rss6().home_pose, 0.1, 5, 0.02, 0.08)
    with pytest.raises(TrajectoryError, match=r"crank \d|leg \d"):
        run_plant(build_plant(quick(), rss6()), DrawnSensor(np.diag(SIGMA**2)), wild, 10.0, 0, 0)


def test_the_loop_keeps_covariances_and_starts_the_sensors_run(sensor):
    told = Told(sensor)
    eye = SensorInLoop(told, rss6(), seed=7)
    assert eye.measure(0, 0.0, rss6().home_pose, np.arange(6.0) * 1e-3) is not None
    assert np.all(np.linalg.eigvalsh(eye.covariances[0]) > 0)
    assert told.seeds == [7]
    assert np.array_equal(told.rates[0], np.arange(6.0) * 1e-3)


def test_the_sensor_gets_the_scenarios_timing(sensor):
    scenario = quick(**{"timing.exposure_s": 0.004, "timing.dropout": 0.25, "timing.latency_s": 0.01})
    timing = make_sensor(scenario, rss6(), 0, sensor.taught).timing
    assert (timing.frame_rate, timing.exposure, timing.dropout, timing.latency) == (60.0, 0.004, 0.25, 0.01)


def test_latencies_are_drawn_only_where_there_is_jitter_and_the_model_knows_the_mean():
    scenario = quick(**{"timing.latency_s": 0.01, "timing.latency_jitter_s": 0.002})
    drawn = scenario.timing.drawn_latencies(400, np.random.default_rng(0))
    assert drawn.std() == pytest.approx(0.002, rel=0.15)
    assert model_settings(scenario).timing.latency_s == 0.01
    assert quick(**{"timing.latency_s": 0.01}).timing.drawn_latencies(400, np.random.default_rng(0)) is None


def test_jitter_changes_the_run_and_follows_the_seed():
    def true(seed, jitter_s):
        scenario = quick(**{"timing.latency_s": 0.01, "timing.latency_jitter_s": jitter_s})
        eye = DrawnSensor(np.diag(SIGMA**2))
        return true_poses(run_plant(build_plant(scenario, rss6()), eye, trajectory(3), 0.5, seed, 0).truth)

    jittered = true(0, 0.005)
    assert np.array_equal(jittered, true(0, 0.005))
    assert 1e-7 < np.abs(jittered - true(0, 0.0)).max() < 1e-3
    assert not np.array_equal(jittered, true(1, 0.005))


def test_dropped_frames_are_lost_by_name_and_the_loop_goes_on(run_of):
    record = run_of(dropout=0.2).record
    lost = np.flatnonzero(record["measured_ok"].values == 0)
    assert 0 < len(lost) < 15
    assert f"frame {lost[0]} " in record.attrs["lost_frames"]
    assert "dropped frame" in record.attrs["lost_frames"]
    held = lost[lost > 0]
    assert np.array_equal(record["command"].values[held], record["command"].values[held - 1])


@pytest.mark.slow
def test_an_exposure_is_blurred_by_the_true_rate_and_its_middle_is_measured(run_of):
    """At up to 0.09 m/s pictures of 8 ms differ from sharp ones; their pose is still that of the middle."""
    fast = random_trajectory(np.random.default_rng(3), rss6().home_pose, 1.0, 3, 0.010, 0.04)
    sharp, blurred = (run_of(path=fast, exposure_s=exposure) for exposure in (0.0, 0.008))
    errors = [poses(run.record, "measured") - true_poses(run.truth) for run in (sharp, blurred)]
    assert not np.array_equal(*errors)
    assert np.sqrt(np.mean(errors[1][:, :3] ** 2, axis=0)).max() < 20e-6
