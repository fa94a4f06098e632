"""Rate, latency with jitter and dropout of a sensor."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from cmmsim.files.schema import Timing
from cmmsim.geometry.pose import pose_to_transform
from cmmsim.measuring.measurement import lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator
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


@pytest.mark.slow
def test_frames_drop_out_as_often_as_stated_independently_for_a_reason_and_with_the_same_seed_alike():
    sensor = dropping(0.3)
    found = [sensor.measure(sensor.home) for _ in range(120)]
    lost = np.array([not m.ok for m in found])
    assert all("dropped frame" in m.reason for m in found if not m.ok)
    for dropped, probability in ((lost, 0.3), (lost[::2] & lost[1::2], 0.3**2)):
        low, high = stats.binom.interval(0.999, len(dropped), probability)
        assert low <= dropped.sum() <= high
    again = [
        [not s.measure(s.home).ok for _ in range(30)]
        for s in (dropping(0.3), dropping(0.3, seed=4))
    ]
    assert again[0] == lost[:30].tolist() != again[1]


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


def test_the_prediction_goes_on_through_missed_frames():
    """A stand-in for the estimator: the platform moves 1 mm a frame, and the tracker says where it
    expects it. The second frame is measured again when its movement is known.
    """
    expected, never = [], pytest.fail  # no image is looked at

    def at(frame):
        return pose_to_transform([1e-3 * frame, 0.0, 0.0, 0.0, 0.0, 0.0])

    class Estimator(PoseEstimator):
        settings = SimpleNamespace(exposed_share=0.0, row_share=0.0)

        def __init__(self):
            pass

        def locate(self, images):
            return at(images.number)

        def measure(self, images, predicted, exposure_ends=None, frame_ends=None):
            assert exposure_ends is None
            expected.append(predicted[0, 3])
            return lost_measurement("stands for a good one"), at(images.number)

        measure_anew = measure

    tracker = Tracker(Estimator())
    tracker.miss()
    for frame in range(9):
        if frame in (3, 4, 6):
            tracker.miss()
        else:
            tracker.measure(SimpleNamespace(number=frame, full=never, windows=never))
    np.testing.assert_allclose(expected, np.array([0, 0, 1, 2, 5, 7, 8]) * 1e-3, atol=1e-15)
