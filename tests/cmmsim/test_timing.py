"""Rate, latency with jitter and dropout of a sensor."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from cmmsim.acceptance import SensorUnderTest, common_volume, latency_test
from cmmsim.files.schema import Timing
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.pose_estimation.estimator import PoseEstimator, lost_measurement
from cmmsim.tracker import Tracker
from tests.cmmsim.sensors import CROPPED, exact


def dropping(probability, seed=0):
    """A sensor with a dropout, which sees the platform and little else."""
    return exact("perfect", CROPPED | {"timing.dropout": probability}, seed=seed)


@pytest.mark.parametrize("jitter", [0.002, 0.008, 0.020])
def test_latencies_are_a_clipped_normal_distribution(jitter):
    """Against SciPy's distribution function, and its mass at the two clips."""
    timing = Timing(frame_rate=60.0, latency=0.020, latency_jitter=jitter)
    drawn = timing.drawn_latencies(20_000, np.random.default_rng(1))
    widest = min(3 * jitter, 0.020)
    assert (drawn.min(), drawn.max()) == (0.020 - widest, 0.020 + widest)
    assert drawn.max() == timing.largest_latency
    inside = drawn[np.abs(drawn - 0.020) < widest]
    ends = widest / jitter
    assert stats.kstest(inside, stats.truncnorm(-ends, ends, 0.020, jitter).cdf).pvalue > 0.001
    share = stats.binomtest(len(drawn) - len(inside), len(drawn)).proportion_ci(0.999)
    assert share.low < 2 * stats.norm.sf(ends) < share.high
    assert abs(drawn.mean() - 0.020) < 4 * drawn.std() / np.sqrt(len(drawn))
    steady = Timing(frame_rate=60.0, latency=0.020).drawn_latencies(50, np.random.default_rng(1))
    np.testing.assert_array_equal(steady, np.full(50, 0.020))


def test_the_acceptance_test_of_latency_finds_the_jitter():
    file = read_sensor_file("ctrack780")
    timing = Timing(frame_rate=60.0, latency=0.014, latency_jitter=0.001)
    under_test = SensorUnderTest(file.model_copy(update={"timing": timing}), 0, "analytic")
    found = latency_test(under_test, common_volume(file.rig), frames=100).latency
    assert found.mean == pytest.approx(0.014, abs=4e-4)
    assert found.std == pytest.approx(0.001, rel=0.25)
    assert found.resolution < 1e-4


def test_frames_drop_out_as_often_as_stated_and_independently():
    sensor = dropping(0.3)
    lost = np.array([not sensor.measure(sensor.home).ok for _ in range(200)])
    low, high = stats.binom.interval(0.999, 200, 0.3)
    assert low <= lost.sum() <= high
    low, high = stats.binom.interval(0.999, 100, 0.3**2)
    assert low <= (lost[::2] & lost[1::2]).sum() <= high


def test_a_dropped_frame_says_so_and_the_same_seed_drops_the_same():
    sensor = dropping(1.0)
    measured = sensor.measure(sensor.home)
    assert not measured.ok
    assert "dropped frame" in measured.reason
    patterns = []
    for seed in (3, 3, 4):
        sensor = dropping(0.5, seed)
        patterns.append([sensor.measure(sensor.home).ok for _ in range(30)])
    assert patterns[0] == patterns[1] != patterns[2]


def test_the_images_of_other_frames_are_the_same_with_and_without_dropout():
    """Six frames of which some drop out, then one more: the same grey values, noise and all."""
    corners = np.array([[[400, 300], [450, 320]], [[410, 300], [480, 330]]])
    grey = []
    for probability in (0.0, 0.5, 1.0):
        sensor = dropping(probability, seed=5)
        for _ in range(6):
            sensor.measure(sensor.home)
        grey.append(sensor.look(sensor.home).windows(corners, 16))
    assert np.array_equal(grey[0], grey[1])
    assert np.array_equal(grey[0], grey[2])
    assert not np.array_equal(grey[0], sensor.look(sensor.home).windows(corners, 16))


def test_after_dropped_frames_the_moving_platform_is_measured_again_at_once(moving_path):
    sensor, lost = dropping(0.4), 0
    for pose in moving_path(60):
        measured = sensor.measure(pose)
        assert measured.ok or "dropped" in measured.reason
        lost += not measured.ok
        if measured.ok:
            assert np.abs(measured.pose - pose)[:3].max() < 100e-6
    assert lost > 10


def test_the_prediction_goes_on_through_missed_frames():
    """A stand-in for the estimator: the platform moves 1 mm a frame, and the tracker says where it expects it."""
    expected, never = [], pytest.fail  # no image is looked at

    class Estimator(PoseEstimator):
        settings = SimpleNamespace(exposed_share=0.0)

        def __init__(self):
            pass

        def locate(self, images):
            return _at(images.number)

        def measure(self, images, predicted, swept=None):
            assert swept is None
            expected.append(predicted[0, 3])
            good = lost_measurement("stands for a good one")
            return good, _at(images.number)

        measure_anew = measure

    tracker = Tracker(Estimator())
    tracker.miss()
    for frame in range(9):
        if frame in (3, 4, 6):
            tracker.miss()
        else:
            tracker.measure(SimpleNamespace(number=frame, full=never, windows=never))
    np.testing.assert_allclose(expected, np.array([0, 0, 2, 5, 7, 8]) * 1e-3, atol=1e-15)


def _at(frame):
    place = np.eye(4)
    place[0, 3] = 1e-3 * frame
    return place
