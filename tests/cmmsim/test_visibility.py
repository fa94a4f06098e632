"""What both cameras can look for, against what the sensor measures."""

from dataclasses import replace

import numpy as np
import pytest

import cmmsim
from cmmsim.visibility import expected_covariance, sight_lines

HOME = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


def test_all_stickers_are_visible_at_home_and_few_with_the_platform_turned_away_or_beyond_the_image():
    sight = sight_lines("ctrack780")
    assert sight.visible(HOME).all()
    away = sight.visible(HOME + np.array([0, 0, 0, 0, 0, np.pi / 2]))
    assert not away.all()
    assert not sight.visible(HOME + np.array([0, 0, 0, 0, np.pi, 0]))[sight.platform.plane_index == 0].any()
    narrow = replace(sight.rig, left=replace(sight.rig.left, focal_px=12 * sight.rig.left.focal_px))
    assert not replace(sight, rig=narrow).visible(HOME).all()


@pytest.mark.parametrize("method", ["registration", "planes"])
def test_expected_covariance_is_the_one_the_taught_sensor_states(method, taught):
    sensor = cmmsim.load_sensor("ctrack780", method=method, taught=taught, renderer="analytic")
    stated = sensor.measure(HOME).covariance
    expected = expected_covariance("ctrack780", HOME, method)
    deviations = np.sqrt(np.diag(expected) / np.diag(stated))
    np.testing.assert_allclose(deviations, 1.0, atol=0.05)
