"""Images of our renderers against physically based ones by Mitsuba 3, an optional dependency."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.pose import apply
from cmmsim.imaging.renderer import Views
from tests.cmmsim.sensors import (
    CROPPED,
    NOISE_FREE,
    TWELVE_BIT,
    centre_errors,
    corners_about,
    exact,
    placed_at,
    poses_about_home,
    refused,
)

SIZE = 18
FINE = CROPPED | NOISE_FREE | TWELVE_BIT


def centres(sensor, light, corners):
    """Centres (n, 2) px that are fitted in windows of one camera without noise."""
    grey = replace(sensor.noise, enabled=False).mean_grey(light)
    limits = FitLimits(largest_misfit=np.inf)
    fits = fit_ellipses(grey, corners, sensor.noise, SIZE - 2, limits, lit=True)
    assert fits.good.all()
    return fits.centres


def test_centres_of_evenly_lit_stickers_are_those_of_a_physically_based_renderer():
    pytest.importorskip("mitsuba")
    ours, other = exact(), exact(renderer="mitsuba")
    for pose in poses_about_home(ours, 2):
        gap = centre_errors(other, pose, 32, SIZE) - centre_errors(ours, pose, size=SIZE)
        assert np.sqrt(np.mean(gap**2)) < 0.001
        assert np.abs(gap.mean(axis=0)).max() < 0.0004


def test_a_missing_mitsuba_is_said_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    sensor = exact(renderer="mitsuba")
    refused(lambda: sensor.capture(sensor.home), "needs Mitsuba 3, which is not installed")


def test_centres_of_stickers_under_a_lamp_are_those_of_a_physically_based_renderer():
    pytest.importorskip("mitsuba")
    from cmmsim.imaging.mitsuba_renderer import PointLamp, draw_frames

    place, target = np.array([0.6, 0.4, 0.9]), np.array(CROPPED["rig.target"])
    lamps = {"light.ambient": 0.0, "light.lamps": [{"place": place.tolist(), "strength": 1.0}]}
    sensor = exact("perfect", FINE | lamps)
    corners = corners_about(sensor, sensor.home, SIZE)
    placed = placed_at(sensor, sensor.home)
    ours = sensor.camera.radiances([[placed]], [corners], SIZE, 9)[0]
    strength = float(np.sum((place - target) ** 2))
    for side, camera in enumerate(sensor.rig.cameras):
        lamp = PointLamp(apply(placed[side][1], place[None])[0], strength)
        views = Views.of_sides([(camera.ideal, placed[side], corners[side])], (SIZE, SIZE))
        # The estimator's scene has no print, so its drawable is the whole scene.
        drawn = draw_frames(
            exact("perfect", FINE).camera.formation.drawable, views, 32, 0.0, [lamp]
        )
        middle = slice(SIZE // 2 - 1, SIZE // 2 + 1)
        levels = (
            drawn[:, middle, middle].mean(axis=(1, 2)),
            ours[side][:, middle, middle].mean((1, 2)),
        )
        lit = levels[1] > 0.2
        assert lit.sum() >= 12
        np.testing.assert_allclose(levels[0][lit], levels[1][lit], rtol=0.02)
        gap = centres(sensor, drawn[lit], corners[side][lit]) - centres(
            sensor, ours[side][lit], corners[side][lit]
        )
        assert np.sqrt(np.mean(gap**2)) < 0.002
