"""Rendered images against the analytic projection."""

import sys

import numpy as np
import pytest

import cmmsim
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.disc_image import eccentricity
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.imaging.exposure import SUPERSAMPLING
from cmmsim.radiometry.noise import CameraNoise

pytestmark = pytest.mark.rendering
NOISE = CameraNoise(1600.0, 0.13, 26.0, 1800.0, 16.0, enabled=False)


def centre_errors(sensor, pose, supersampling):
    """Fitted minus projected sticker centres (36, 2), px, from noise-free windows."""
    base_from_platform = pose_to_transform(pose)
    scene, body = sensor._scene[0], sensor.platform
    errors, corners, windows_of = [], [], []
    moves = [m @ sensor._camera_from_base for m in sensor.rig.from_camera]
    for camera, move in zip(sensor.rig.cameras, moves, strict=True):
        points = apply(move @ base_from_platform, scene.sticker_places)
        pixels = camera.project(points)[0]
        bias = eccentricity(points, body.sticker_normals @ (move @ base_from_platform)[:3, :3].T, 0.003, 2300.0)
        windows_of.append(pixels + bias)
        corners.append(np.rint(pixels - 7.5).astype(int))
    placed = [np.stack([m @ base_from_platform, m]) for m in moves]
    radiance = sensor.camera.radiance(placed, np.stack(corners), 16, supersampling)
    for windows, corner, expected in zip(radiance, corners, windows_of, strict=True):
        fits = fit_ellipses(NOISE.mean_grey(windows), corner, NOISE, 14)
        assert fits.good.all()
        errors.append(fits.centres - expected)
    return np.concatenate(errors)


@pytest.mark.parametrize(("supersampling", "limit"), [(6, 0.0016), (SUPERSAMPLING, 0.0008), (16, 0.0003)])
def test_sticker_centres_agree_with_their_projection(sensor, supersampling, limit):
    """The pixel convention: half a pixel off would be 0.5; the rest falls with supersampling as the renderer states."""
    rng = np.random.default_rng(0)
    errors = np.concatenate(
        [
            centre_errors(sensor, sensor.home + rng.uniform(-1, 1, 6) * ([0.009] * 3 + [0.03] * 3), supersampling)
            for _ in range(8)
        ]
    )
    rms, mean = np.sqrt((errors**2).mean(axis=0)), errors.mean(axis=0)
    assert np.all(rms < limit), rms
    assert np.all(np.abs(mean) < 0.0002), mean
    assert 0.85 < np.sqrt((errors**2).mean()) / render.PYRENDER.centre_error_px(supersampling) < 1.15


def test_whole_image_shows_the_windows(sensor):
    """Around every sticker the whole image has the radiance of the finely drawn window.

    Single samples on an edge may fall to the other side by rounding: one of the 81 in a pixel is granted.
    """
    placed = [
        np.stack([m @ sensor._camera_from_base @ pose_to_transform(sensor.home), m @ sensor._camera_from_base])
        for m in sensor.rig.from_camera
    ]
    points = apply(sensor._camera_from_base @ pose_to_transform(sensor.home), sensor._scene[0].sticker_places)
    corners = np.rint(sensor.rig.project(points)[0] - 5.5).astype(int)
    windows = sensor.camera.radiance(placed, corners, 12, SUPERSAMPLING)
    for side in (0, 1):
        image = sensor.camera.whole_exposure(side, [placed[side]], SUPERSAMPLING)
        for (x, y), window in zip(corners[side], windows[side], strict=True):
            assert np.abs(image[y : y + 12, x : x + 12] - window).max() < 1.0 / SUPERSAMPLING**2


def test_captured_images_have_the_stated_size_and_type(sensor):
    frame = sensor.capture(sensor.home)
    assert frame.left.shape == frame.right.shape == (1536, 2048)
    assert frame.left.dtype == frame.right.dtype == np.uint8
    assert frame.left.max() > 200 > 30 > np.median(frame.left)


def test_missing_opengl_names_the_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrender", None)
    with pytest.raises(cmmsim.OpenGLMissingError, match=r"libegl1\b.* and libgl1-mesa-dri"):
        render._shared_atlas.__wrapped__()
