"""A sensor's distance and its number of stickers as single keys."""

import numpy as np
import pytest

from cmmsim.errors import SensorFileError
from cmmsim.files.sensor_file import read_sensor_file


def places(count):
    planes = read_sensor_file("ctrack780", {"stickers.per_plane": count, "stickers.ring_radius": 0.006}).platform.planes
    return {name: np.array(plane.stickers) for name, plane in planes}


@pytest.mark.parametrize("count", [3, 4, 7, 18])
def test_stickers_of_any_number_have_the_middle_of_those_listed_and_half_their_variance(count):
    for name, plane in read_sensor_file("ctrack780").platform.planes:
        listed, ring = np.array(plane.stickers), places(count)[name]
        assert ring.shape == (count, 2)
        np.testing.assert_allclose(ring.mean(axis=0), listed.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(np.cov(ring.T, bias=True), 0.5 * np.cov(listed.T, bias=True), atol=1e-12)


def test_more_stickers_than_there_is_room_for_are_refused_with_plane_and_distance():
    with pytest.raises(SensorFileError, match=r"per_plane = 50 puts stickers 0\.0\d+ m apart on plane A.* 0\.018 m"):
        read_sensor_file("ctrack780", {"stickers.per_plane": 50})


def test_distance_moves_the_rig_along_its_line_of_sight():
    near, far = (read_sensor_file("ctrack780", changes).rig for changes in ({}, {"rig.distance": 3.0}))
    towards = [np.subtract(rig.position, rig.target) for rig in (near, far)]
    assert np.linalg.norm(towards[1]) == pytest.approx(3.0, abs=1e-12)
    np.testing.assert_allclose(towards[1] / 3.0, towards[0] / np.linalg.norm(towards[0]), atol=1e-12)
    assert far.target == near.target


def test_a_resolved_file_reads_back_as_itself():
    file = read_sensor_file("ctrack780", {"rig.distance": 2.0, "stickers.per_plane": 5})
    assert type(file).model_validate_json(file.model_dump_json()) == file
