"""Frames without any fault are measured, however little noise they hold.

GOOD_FRAMES=100000 in the environment draws that many frames for the share that is lost.
"""

import os

import numpy as np
import pytest
from scipy.stats import beta

import cmmsim
from cmmsim.errors import LostError
from cmmsim.geometry.pose import pose_to_transform
from cmmsim.tracker import Tracker
from tests.cmmsim.fault_run import REACH, exactly_taught
from tests.cmmsim.lenses import lens_sensor, pose_errors, poses_about_home

FRAMES, DRAWS = int(os.environ.get("GOOD_FRAMES", "10000")), 100
MOVING_FRAMES = 2000
LEFT_OUT = 1e-3  # largest share of the stickers of good frames that may be left out
GREY = 208.0  # values of white light above black


def little_noise(deviation):
    """Changes of a sensor file: noise of ``deviation`` grey values at white, half of its variance in the dark too."""
    gain = 0.5 * deviation**2 / GREY
    figures = {
        "electrons_at_white = 1600.0": GREY / gain,
        "gain = 0.13": gain,
        "full_well = 1800.0": 1.125 * GREY / gain,
        "dark_noise = 26.0": np.sqrt(0.5) * deviation / gain,
    }
    return [(old, f"{old.split(' = ')[0]} = {float(value)}") for old, value in figures.items()]


@pytest.mark.parametrize("deviation", [0.1, 0.2, 0.3, 0.5])
@pytest.mark.parametrize(
    ("lens", "renderer", "count"),
    [
        ("perfect", "analytic", 60),
        ("all", "analytic", 6),
        pytest.param("perfect", "pyrender", 25, marks=pytest.mark.rendering),
    ],
)
def test_little_noise_loses_no_frame(tmp_path, lens, renderer, count, deviation):
    """Rounding to whole grey values then decides; the covariance stays true, nearly all stickers are taken."""
    sensor = lens_sensor(tmp_path, lens, renderer, changes=little_noise(deviation))
    errors, found = pose_errors(sensor, poses_about_home(sensor, count))
    assert np.mean([len(m.target_ids) for m in found]) > 17.0
    squared = [e @ np.linalg.solve(m.covariance, e) for e, m in zip(1e-6 * errors, found, strict=True)]
    assert np.mean(squared) == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / count))


@pytest.mark.slow
def test_good_frames_are_not_lost(taught, monkeypatch, record_property):
    """None of them; the one-sided 95 % limit of the share (Clopper and Pearson) is then 3 over their number.

    Each pose is drawn once and exposed many times.
    """
    sensor = cmmsim.load_sensor("ctrack780", seed=0, taught=taught, renderer="analytic")
    camera, drawn = sensor.camera, {}

    def radiance(placed, corners, size, supersampling, draw=camera.radiance):
        key = corners.tobytes()
        if key not in drawn:
            drawn.clear()
            drawn[key] = draw(placed, corners, size, supersampling)
        return drawn[key]

    monkeypatch.setattr(camera, "radiance", radiance)
    estimator, lost, left_out = sensor.estimator, 0, 0
    for pose in poses_about_home(sensor, FRAMES // DRAWS, seed=7):
        images, expected = sensor.look(pose), sensor._camera_from_base @ pose_to_transform(pose)
        drawn.clear()
        for _ in range(DRAWS):
            try:
                left_out += 18 - len(estimator.measure(images, expected)[0].target_ids)
            except LostError:
                lost += 1
    frames = FRAMES // DRAWS * DRAWS
    upper = beta.ppf(0.95, lost + 1, frames - lost)
    record_property("lost_frames_upper_limit", float(f"{upper:.2g}"))
    record_property("stickers_left_out", float(f"{left_out / (18 * frames):.2g}"))
    assert lost == 0, f"{lost} of {frames} frames"
    assert left_out < LEFT_OUT * 18 * frames


@pytest.mark.slow
def test_no_frame_of_a_moving_platform_is_lost():
    """Steps of up to 0.2 mm and 0.7 mrad in random directions: a movement never goes on as the tracker expects."""
    sensor = exactly_taught()
    rng, tracker = np.random.default_rng(3), Tracker(sensor.estimator)
    pose, count, left_out = sensor.home, len(sensor.platform.sticker_ids), 0
    for _ in range(MOVING_FRAMES):
        pose = sensor.home + np.clip(pose - sensor.home + 0.02 * REACH * rng.uniform(-1.0, 1.0, 6), -REACH, REACH)
        m = tracker.measure(sensor.look(pose))
        assert m.ok, m.reason
        left_out += count - len(m.target_ids)
    assert left_out < LEFT_OUT * MOVING_FRAMES * count
