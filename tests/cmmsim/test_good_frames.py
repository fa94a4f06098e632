"""Frames without any fault are measured, however little noise they hold."""

import numpy as np
import pytest
from scipy.stats import beta

import cmmsim
from cmmsim.errors import LostError
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.tracker import Tracker
from tests.cmmsim.sensors import (
    CROPPED,
    REACH,
    camera_from,
    exact,
    pose_errors,
    poses_about_home,
    require_true,
    squared_errors,
)

DRAWS = 100
LEFT_OUT = 1e-3  # largest share of the stickers of good frames that may be left out
GREY = 208.0  # values of white light above black


def little_noise(deviation):
    """Changes of a sensor file: noise of ``deviation`` grey values at white, half of its variance
    in the dark too.
    """
    gain = 0.5 * deviation**2 / GREY
    figures = {
        "electrons_at_white": GREY / gain,
        "gain": gain,
        "full_well": 1.125 * GREY / gain,
        "dark_noise": np.sqrt(0.5) * deviation / gain,
    }
    return {f"camera.{key}": float(value) for key, value in figures.items()}


@pytest.mark.parametrize("deviation", [0.1, 0.2, 0.3, 0.5])
@pytest.mark.parametrize(
    ("lens", "renderer", "count"),
    [
        ("perfect", "analytic", 25),
        ("all", "analytic", 6),
        pytest.param("perfect", "pyrender", 10, marks=pytest.mark.rendering),
    ],
)
def test_little_noise_loses_no_frame(lens, renderer, count, deviation):
    """Rounding to whole grey values then decides; the covariance stays true, nearly all stickers
    are taken.
    """
    sensor = exact(lens, little_noise(deviation), renderer)
    poses = poses_about_home(sensor, count)
    _, found = pose_errors(sensor, poses)
    assert np.mean([len(m.target_ids) for m in found]) > 17.0
    require_true(squared_errors(found, poses))


@pytest.mark.parametrize(
    "frames",
    [pytest.param(400, marks=pytest.mark.slow), pytest.param(100_000, marks=pytest.mark.thorough)],
)
def test_good_frames_are_not_lost(taught, monkeypatch, record_property, frames):
    """None of them; the one-sided 95 % limit of the share (Clopper and Pearson) is then 3 over
    their number.

    Each pose is drawn once and exposed many times.
    """
    sensor = cmmsim.load_sensor("ctrack780", taught=taught, renderer="analytic")
    drawn, draw = {}, VirtualStereoCamera.radiances

    def radiances(camera, moments, corners, size, supersampling, sweeps=None):
        key = corners[0].tobytes()
        if key not in drawn:
            drawn.clear()
            drawn[key] = draw(camera, moments, corners, size, supersampling, sweeps)
        return drawn[key]

    monkeypatch.setattr(VirtualStereoCamera, "radiances", radiances)
    estimator, lost, left_out = sensor.estimator, 0, 0
    for pose in poses_about_home(sensor, frames // DRAWS, seed=7):
        images, expected = sensor.look(pose), camera_from(sensor, pose)
        drawn.clear()
        for _ in range(DRAWS):
            try:
                left_out += 18 - len(estimator.measure(images, expected)[0].target_ids)
            except LostError:
                lost += 1
    record_property(
        "lost_frames_upper_limit", float(f"{beta.ppf(0.95, lost + 1, frames - lost):.2g}")
    )
    record_property("stickers_left_out", float(f"{left_out / (18 * frames):.2g}"))
    assert lost == 0, f"{lost} of {frames} frames"
    assert left_out < LEFT_OUT * 18 * frames


@pytest.mark.parametrize(
    "frames",
    [pytest.param(120, marks=pytest.mark.slow), pytest.param(2000, marks=pytest.mark.thorough)],
)
def test_no_frame_of_a_moving_platform_is_lost(frames):
    """Steps of up to 0.2 mm and 0.7 mrad in random directions: a movement never goes on as the
    tracker expects.
    """
    sensor = exact("perfect", CROPPED)
    rng, tracker = np.random.default_rng(3), Tracker(sensor.estimator)
    pose, left_out = sensor.home, 0
    for _ in range(frames):
        pose = sensor.home + np.clip(
            pose - sensor.home + 0.02 * REACH * rng.uniform(-1.0, 1.0, 6), -REACH, REACH
        )
        m = tracker.measure(sensor.look(pose))
        assert m.ok, m.reason
        left_out += 18 - len(m.target_ids)
    assert left_out < LEFT_OUT * frames * 18
