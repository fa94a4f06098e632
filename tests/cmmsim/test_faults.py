"""Spoilt images: what is left is measured, or the frame is lost for a reason; no wrong pose is reported as good."""

import os

import numpy as np
import pytest
from scipy.stats import binom, chi2

import cmmsim
from cmmsim.fault_images import DiscMark, Fault, FaultyImages, FillMark, GlintMark, PlateMark, paint
from cmmsim.faults import FaultGenerator
from cmmsim.radiometry.images import FrameImages, StereoFrame
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.tracker import Tracker
from tests.cmmsim.fault_run import exactly_taught, run_faults

FIVE_SIGMA = 5.733e-7  # two-sided, of a normal variable
WRONG = chi2.isf(FIVE_SIGMA, 6)
REGION = chi2.ppf(0.95, 6)
LOSING = ("one_camera_dark", "one_camera_covered", "swapped", "black", "saturated")
SPOILING = ("hidden", "half_hidden", "obstacles", "false_discs", "false_points", "glint", "merging", "several")
NOISE = CameraNoise(1600.0, 0.13, 26.0, 1800.0, 16.0)


@pytest.fixture(scope="module")
def sensor():
    return exactly_taught()


def require_honest(outcomes):
    """No wrong pose, and the 95 % regions of the frames reported good hold as many true poses as they should."""
    squared = np.concatenate([o.squared for o in outcomes.values()])
    largest = {kind: max(o.squared, default=0.0) for kind, o in outcomes.items()}
    assert max(largest.values()) < WRONG, largest
    least, most = binom.interval(0.9999, len(squared), 0.95)
    assert least <= np.sum(squared < REGION) <= most, (np.mean(squared < REGION), len(squared))
    for o in outcomes.values():
        assert len(o.squared) + sum(o.reasons.values()) == o.frames
        assert min(o.stickers, default=4) >= 4


def test_no_wrong_pose_in_some_hundred_faults(sensor):
    outcomes = run_faults(sensor, SPOILING, 150, 1, untracked=0.0)
    require_honest(outcomes)
    for kind in ("obstacles", "false_discs", "false_points", "glint"):
        assert len(outcomes[kind].squared) > 0.9 * outcomes[kind].frames, (kind, outcomes[kind].reasons)


@pytest.mark.parametrize("kind", LOSING)
def test_whole_frame_faults_are_lost_with_the_reason(sensor, kind):
    outcome = run_faults(sensor, [kind], 4, 2)[kind]
    assert not outcome.squared
    for reason in outcome.reasons:
        assert "needed" in reason or "two poses" in reason or "contradict" in reason, reason


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10 if os.environ.get("ALL_FAULTS") else 1))
def test_no_wrong_pose_in_ten_thousand_faults(sensor, part):
    """With the tests of the same name 1,000 faults, and 10,000 where the environment has ALL_FAULTS=1."""
    kinds = [*SPOILING, *SPOILING, *SPOILING, *LOSING]
    require_honest(run_faults(sensor, kinds, 1000, 100 + part))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(8 if os.environ.get("ALL_FAULTS") else 1))
def test_planes_report_no_wrong_pose(part):
    require_honest(run_faults(exactly_taught("planes"), SPOILING, 250, 200 + part, untracked=0.02))


def jump(rng):
    """Where the platform may be in the next frame: up to 10 mm and 40 mrad off in each coordinate."""
    return rng.uniform(-1.0, 1.0, 6) * ([0.01] * 3 + [0.04] * 3)


def require_found_again(sensor):
    """After ten lost frames, and after a jump, the very next good frame is measured with all stickers."""
    rng = np.random.default_rng(4)
    tracker, faults = Tracker(sensor.estimator), FaultGenerator(sensor.estimator)
    pose = sensor.home
    assert tracker.measure(sensor.look(pose)).ok
    for kind in ("black", "one_camera_dark"):
        for _ in range(10):
            m = tracker.measure(FaultyImages(sensor.look(pose), faults.draw(kind, pose, rng), sensor.noise, rng))
            assert not m.ok
            assert "bright spots" in m.reason
        pose = sensor.home + jump(rng)
        require_right(tracker.measure(sensor.look(pose)), pose)
    for _ in range(4):
        pose = sensor.home + jump(rng)
        require_right(tracker.measure(sensor.look(pose)), pose)


def require_right(m, pose):
    assert m.ok, m.reason
    assert len(m.target_ids) >= 17
    assert (m.pose - pose) @ np.linalg.solve(m.covariance, m.pose - pose) < WRONG


def test_lost_frames_and_jumps_are_found_again(sensor):
    require_found_again(sensor)


@pytest.mark.slow
@pytest.mark.rendering
def test_lost_frames_and_jumps_are_found_again_by_pyrender():
    require_found_again(exactly_taught(renderer="pyrender"))


@pytest.mark.slow
@pytest.mark.rendering
def test_no_wrong_pose_drawn_by_pyrender():
    require_honest(run_faults(exactly_taught(renderer="pyrender"), SPOILING, 200, 5))


def test_opaque_marks_have_their_own_mean_and_noise():
    """Where a disc covers everything, grey values are those of an exposure of its radiance."""
    rng = np.random.default_rng(6)
    grey = NOISE.expose(np.full((300, 300), 0.8, dtype=np.float32), rng).astype(float)
    paint(grey, np.array([1000, 500]), DiscMark(0, np.array([1150.0, 650.0]), 120.0 * np.eye(2), 0.3), NOISE, rng)
    inside, outside = grey[100:200, 100:200], grey[:60, :60]
    for part, radiance in ((inside, 0.3), (outside, 0.8)):
        mean = 16.0 + 0.13 * 1600.0 * radiance
        assert part.mean() == pytest.approx(mean, abs=0.5)
        assert part.var() == pytest.approx(0.13**2 * (1600.0 * radiance + 26.0**2), rel=0.1)


def test_marks_reach_windows_and_whole_images_alike():
    """Without noise a window shows what the whole image shows there."""
    noise = CameraNoise(1600.0, 0.13, 0.0, 1800.0, 16.0, enabled=False)
    dark = np.full((120, 160), 16, dtype=np.uint8)
    marks = (
        DiscMark(0, np.array([40.3, 50.6]), 4.0 * np.eye(2), 0.9),
        PlateMark(0, np.array([45.0, 52.0]), np.array([6.0, 3.0]), 0.4, 0.2),
        GlintMark(1, np.array([44.0, 50.0]), 3.0, 1.5, 0.5, 6.0, 0.3),
        FillMark(1, 0.05),
    )
    images = FaultyImages(FrameImages(StereoFrame(dark, dark)), Fault("some", marks), noise, np.random.default_rng(0))
    frame, corners = images.full(), np.array([[[32, 42]], [[36, 41]]])
    windows = images.windows(corners, 16)
    np.testing.assert_array_equal(windows[0, 0], frame.left[42:58, 32:48])
    np.testing.assert_array_equal(windows[1, 0], frame.right[41:57, 36:52])
    assert frame.left.max() == 16 + round(0.13 * 1600 * 0.9)
    swapped = FaultyImages(
        FrameImages(StereoFrame(dark, dark + np.uint8(9))),
        Fault("swapped", swapped=True),
        noise,
        np.random.default_rng(0),
    )
    assert swapped.full().left.max() == swapped.windows(corners, 16)[0].max() == 25


def test_unknown_fault_names_the_valid_ones(sensor):
    with pytest.raises(cmmsim.UnknownOptionError, match="half_hidden"):
        FaultGenerator(sensor.estimator).draw("gremlin", sensor.home, np.random.default_rng(0))


def test_same_seed_same_fault(sensor):
    faults = FaultGenerator(sensor.estimator)
    first, again = (faults.draw("several", sensor.home, np.random.default_rng(7)) for _ in range(2))
    assert [repr(mark) for mark in first.marks] == [repr(mark) for mark in again.marks]
    np.testing.assert_equal(first.obstacles, again.obstacles)
