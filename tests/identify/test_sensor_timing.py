"""The sensor's timing inside the experiment: jitter and dropout drawn from the run's seed, blur from the true rate."""

import numpy as np
import pytest

from cmmsim.files.sensor_file import read_sensor_file
from identify.experiment.plant import build_plant
from identify.experiment.run import run_plant, taught_sensor
from identify.experiment.sensor_in_loop import SensorInLoop, make_sensor
from identify.experiment.truth import true_poses
from identify.loop_parameters import model_settings
from identify.progress import SilentProgress
from identify.record.recording import poses
from identify.trajectory import random_trajectory
from tests.identify.synthetic import quick, rss6, trajectory

ANALYTIC = {"renderer": "analytic", "excitation.duration_s": 1.0}


@pytest.fixture(scope="module")
def taught():
    return taught_sensor(quick(**ANALYTIC), rss6(), 0, SilentProgress()).taught


@pytest.fixture
def record_of(taught):
    """A short run with a timing of its own."""

    def make(seed=0, path=None, **timing):
        scenario = quick(**ANALYTIC, **{f"timing.{key}": value for key, value in timing.items()})
        sensor = make_sensor(scenario, rss6(), 0, taught)
        return run_plant(build_plant(scenario, rss6()), sensor, path or trajectory(3), 0.5, seed, 0)

    return make


def test_the_sensor_gets_the_scenarios_timing(taught):
    scenario = quick(**ANALYTIC, **{"timing.exposure_s": 0.004, "timing.dropout": 0.25, "timing.latency_s": 0.01})
    timing = make_sensor(scenario, rss6(), 0, taught).timing
    assert (timing.frame_rate, timing.exposure, timing.dropout, timing.latency) == (60.0, 0.004, 0.25, 0.01)
    assert read_sensor_file("ctrack780").timing.dropout == 0.0


def test_jitter_changes_the_run_and_follows_the_seed(record_of):
    steady, jittered, again, other = (
        true_poses(record_of(seed, latency_s=0.01, latency_jitter_s=jitter).truth)
        for seed, jitter in ((0, 0.0), (0, 0.005), (0, 0.005), (1, 0.005))
    )
    assert np.array_equal(jittered, again)
    assert 1e-7 < np.abs(jittered - steady).max() < 1e-3
    assert not np.array_equal(jittered, other)


def test_latencies_are_drawn_only_where_there_is_jitter_and_the_model_knows_the_mean():
    scenario = quick(**{"timing.latency_s": 0.01, "timing.latency_jitter_s": 0.002})
    drawn = scenario.timing.drawn_latencies(400, np.random.default_rng(0))
    assert drawn.std() == pytest.approx(0.002, rel=0.15)
    assert model_settings(scenario).timing.latency_s == 0.01
    assert quick(**{"timing.latency_s": 0.01}).timing.drawn_latencies(400, np.random.default_rng(0)) is None


def test_dropped_frames_are_lost_by_name_and_the_loop_goes_on(record_of):
    record = record_of(dropout=0.2).record
    lost = np.flatnonzero(record["measured_ok"].values == 0)
    assert 0 < len(lost) < 15
    assert f"frame {lost[0]} " in record.attrs["lost_frames"]
    assert "dropped frame" in record.attrs["lost_frames"]
    held = lost[lost > 0]
    assert np.array_equal(record["command"].values[held], record["command"].values[held - 1])


def test_an_exposure_is_blurred_by_the_true_rate_and_its_middle_is_measured(record_of):
    """At up to 0.09 m/s pictures of 8 ms differ from sharp ones; their pose is still that of the middle."""
    fast = random_trajectory(np.random.default_rng(3), rss6().home_pose, 1.0, 3, 0.010, 0.04)
    sharp, blurred = (record_of(path=fast, exposure_s=exposure) for exposure in (0.0, 0.008))
    errors = [poses(run.record, "measured") - true_poses(run.truth) for run in (sharp, blurred)]
    assert not np.array_equal(*errors)
    assert np.sqrt(np.mean(errors[1][:, :3] ** 2, axis=0)).max() < 20e-6


def test_the_loop_hands_the_rate_to_the_sensor(taught):
    given = []

    class Sensor:
        def start_run(self, seed):
            given.append(seed)

        def measure(self, pose, obstacles, pose_rate):
            given.append(pose_rate)
            return make_sensor(quick(**ANALYTIC), rss6(), 0, taught).measure(pose, obstacles)

    eye = SensorInLoop(Sensor(), rss6(), seed=7)
    rate = np.arange(6.0)
    eye.measure(0, 0.0, rss6().home_pose, rate)
    assert given[0] == 7
    assert np.array_equal(given[1], rate)
