"""The experiment with images in the loop: what is recorded, what is lost, what is refused.

That images decide the pose (one camera shifted by 0.1 px) is proved in tests/cmmsim/test_measuring.py.
"""

import json

import numpy as np
import pytest
import xarray as xr

import cmmsim
from cmmsim.pose_estimation.estimator import lost_measurement
from dynamics import load_robot
from identify.errors import TrajectoryError
from identify.experiment.plant import build_plant
from identify.experiment.run import run_experiment, run_plant, taught_sensor
from identify.experiment.sensor_in_loop import SensorInLoop, robot_transforms
from identify.experiment.truth import read_truth, true_poses
from identify.progress import SilentProgress
from identify.record.recording import poses
from identify.trajectory import random_trajectory
from tests.identify.synthetic import quick, rss6, trajectory

pytestmark = pytest.mark.rendering


@pytest.fixture(scope="module")
def scenario():
    return quick(**{"excitation.duration_s": 1.0, "excitation.candidates": 2})


@pytest.fixture(scope="module")
def sensor(scenario):
    return taught_sensor(scenario, rss6(), 0, SilentProgress())


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


def test_the_measured_pose_is_the_true_one_to_the_sensors_accuracy(scenario, sensor):
    experiment = run_plant(build_plant(scenario, rss6()), sensor, trajectory(3), 1.0, 0, 0)
    errors = poses(experiment.record, "measured") - true_poses(experiment.truth)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert experiment.record["measured_ok"].values.all()
    assert np.all(rms[:3] < 20e-6), rms
    assert np.all(rms[3:] < 100e-6), rms
    assert np.all(rms > 1e-7), "a measurement without any error would be the truth itself"


def test_the_same_seed_gives_the_same_record_and_another_does_not(scenario, sensor):
    one, two, other = (
        poses(run_plant(build_plant(scenario, rss6()), sensor, trajectory(3), 0.2, seed, 0).record, "measured")
        for seed in (4, 4, 5)
    )
    assert np.array_equal(one, two)
    assert not np.array_equal(one, other)


def test_a_lost_frame_is_counted_holds_the_command_and_does_not_end_the_run(scenario, sensor):
    """A plate in front of the platform for five frames: lost, then found again."""
    blind = _blinded(sensor, frames=range(10, 15))
    experiment = run_plant(build_plant(scenario, rss6()), blind, trajectory(3), 0.5, 0, 0)
    record = experiment.record
    assert list(np.flatnonzero(record["measured_ok"].values == 0)) == [10, 11, 12, 13, 14]
    assert np.isnan(poses(record, "measured")[10:15]).all()
    commands = record["command"].values
    assert np.array_equal(commands[10:15], np.tile(commands[9], (5, 1)))
    assert "frame 10" in record.attrs["lost_frames"]


def _blinded(sensor, frames):
    """The sensor with its answers taken away in some frames, as a shutter would."""

    class Blinded:
        def __init__(self):
            self.frame = -1

        def start_run(self, seed):
            sensor.start_run(seed)

        def measure(self, pose, obstacles=None, pose_rate=None):
            self.frame += 1
            measured = sensor.measure(pose, obstacles, pose_rate)
            return lost_measurement("shutter closed") if self.frame in frames else measured

    return Blinded()


def test_run_experiment_returns_what_it_writes(scenario, tmp_path):
    record = run_experiment(scenario, seed=2, path=tmp_path / "experiment.nc")
    with xr.open_dataset(tmp_path / "experiment.nc") as stored:
        assert np.array_equal(stored["measured_position"], record["measured_position"])
        assert stored["measured_position"].attrs["units"] == "m"
    truth = read_truth(record.attrs["path"])
    assert true_poses(truth).shape == (60, 6)
    assert "truth" not in " ".join(map(str, record.data_vars))
    assert abs(record.attrs["scale_anchor_value"] - 23.5) < 5 * record.attrs["scale_anchor_std"]
    assert record.attrs["scale_anchor_value"] != 23.5
    assert json.loads(record.attrs["robot_geometry"])["crank_length"] == 0.06


def test_a_trajectory_beyond_the_travel_is_refused_before_the_run(scenario, sensor):
    wild = random_trajectory(np.random.default_rng(0), rss6().home_pose, 0.1, 5, 0.02, 0.08)
    with pytest.raises(TrajectoryError, match=r"crank \d|leg \d"):
        run_plant(build_plant(scenario, rss6()), sensor, wild, 10.0, 0, 0)


def test_sensor_in_loop_passes_obstacles_and_keeps_covariances(sensor):
    eye = SensorInLoop(sensor, load_robot("rss6"), seed=1)
    assert eye.measure(0, 0.0, rss6().home_pose, np.zeros(6)) is not None
    assert np.all(np.linalg.eigvalsh(eye.covariances[0]) > 0)
