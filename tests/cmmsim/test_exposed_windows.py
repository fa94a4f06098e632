"""Windows over an exposure are the mean of all its moments, though what stands still is drawn once."""

import numpy as np
import pytest

from cmmsim.geometry.pose import pose_to_transform
from cmmsim.imaging.exposure import exposed_windows
from cmmsim.imaging.formation import ImageFormation, Side
from tests.cmmsim.lenses import lens_sensor

SIZE = 64


def moments_of(sensor, count):
    """camera_from_bodies (b,4,4) of the left camera while the platform moves by 6 mm."""
    move = sensor.rig.from_camera[0] @ sensor._camera_from_base
    shifts = np.linspace(-0.003, 0.003, count)
    return [np.stack([move @ pose_to_transform(sensor.home + s * np.eye(6)[1]), move]) for s in shifts]


def tiles():
    x, y = np.meshgrid(SIZE * np.arange(32), SIZE * np.arange(24))
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("lens", ["perfect", "all"])
def test_they_show_what_drawing_every_window_at_every_moment_shows(tmp_path, monkeypatch, lens):
    sensor, drawn = lens_sensor(tmp_path, lens), []
    formation, camera, moments = sensor.camera.formation, sensor.rig.left, moments_of(sensor, 4)
    every = [formation.windows([Side(camera, bodies, tiles())], SIZE, 2, 1, shade=False)[0] for bodies in moments]
    draw = ImageFormation.windows

    def counted(self, sides, *arguments, **options):
        drawn.append(len(sides[0].corners))
        return draw(self, sides, *arguments, **options)

    monkeypatch.setattr(ImageFormation, "windows", counted)
    mean, largest = exposed_windows(formation, camera, moments, tiles(), SIZE, 2, 1)
    np.testing.assert_allclose(mean, np.mean(every, axis=0), atol=1e-6)
    np.testing.assert_allclose(largest, np.max(every, axis=0), atol=1e-6)
    assert np.any(np.ptp(every, axis=0) > 0.5)
    assert sum(drawn) < 0.5 * len(moments) * len(tiles())


def test_one_moment_is_drawn_once(tmp_path):
    sensor = lens_sensor(tmp_path)
    (bodies,) = moments_of(sensor, 1)
    formation, camera = sensor.camera.formation, sensor.rig.left
    expected = formation.windows([Side(camera, bodies, tiles())], SIZE, 2, shade=False)[0]
    for found in exposed_windows(formation, camera, [bodies], tiles(), SIZE, 2):
        np.testing.assert_array_equal(found, expected)
