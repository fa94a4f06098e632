"""The measuring volume, the seven lines and the paths of the bar, checked by geometry."""

from dataclasses import replace

import numpy as np
import pytest

from cmmsim.acceptance import AcceptanceError, bar_paths, common_volume, require_rules, seven_lines, volume_of_size
from cmmsim.acceptance.artefacts import LENGTH, bar_ends, rigid_bar
from cmmsim.acceptance.latency_test import require_room
from cmmsim.acceptance.length_test import length_artefact
from cmmsim.acceptance.moving_bar import SECONDS
from cmmsim.acceptance.volume import CORNERS, MARGIN_PX, MeasuringLine
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.files.setup import marked_body, rig_from_file
from cmmsim.geometry.pose import apply, pose_to_transform

RIG = read_sensor_file("ctrack780").rig


@pytest.fixture(scope="module")
def volume():
    return common_volume(RIG)


def corner_pixels(volume):
    rig, camera_from_base = rig_from_file(RIG)
    return rig.project(apply(camera_from_base @ volume.base_from_volume, CORNERS * volume.size))[0]


def test_volume_is_the_largest_that_both_cameras_see_along_their_axes(volume):
    """x goes right and y down in both images, and what is further away is smaller."""
    pixels = corner_pixels(volume)
    room = np.minimum(pixels, np.array([RIG.width, RIG.height]) - 1 - pixels)
    assert room.min() >= MARGIN_PX
    assert room.min() < MARGIN_PX + 3.0  # a millimetre more would be too much
    place, turn = volume.base_from_volume[:3, 3], volume.base_from_volume[:3, :3]
    np.testing.assert_allclose(place, RIG.target)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    distance = np.linalg.norm(np.subtract(RIG.target, RIG.position))
    assert volume.depth_range == pytest.approx((distance - volume.size[2] / 2, distance + volume.size[2] / 2))
    for side in pixels:
        at = dict(zip(map(tuple, CORNERS), side, strict=True))
        assert at[0.5, 0.5, -0.5][0] > at[-0.5, 0.5, -0.5][0]
        near, far = (at[0.5, 0.5, z][1] - at[0.5, -0.5, z][1] for z in (-0.5, 0.5))
        assert 0.0 < far < near


def sized(*sides):
    return volume_of_size(RIG, np.array(sides))


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda: sized(2.0, 0.5, 0.5),
            r"2000 x 500 x 500 mm is not wh.*corner \(-1000, .*px.*largest cube.*682 mm",
        ),
        (lambda: sized(0.5, 0.5, 3.0), r"front face comes within \d+ mm"),
        (lambda: sized(0.5, 0.05, 0.5), "at least 100 mm"),
        (lambda: sized(0.5, np.nan, 0.5), "three sides"),
        # cameras that look away from each other, so that no point is in both images
        (lambda: common_volume(RIG.model_copy(update={"focal_px": 6e4})), "nothing is visible to both cameras"),
        (lambda: seven_lines(sized(0.6, 0.3, 0.3)), r"two thirds.*nearer to a cube"),
        (lambda: bar_paths(sized(0.3, 0.3, 0.3)), r"raster x, bar along x: the bar needs .* the volume has 300 x 300"),
        (lambda: require_room(sized(0.3, 0.3, 0.3)), "body on its circle needs"),
    ],
)
def test_volumes_that_cannot_be_or_hold_too_little_are_refused(ask, message):
    with pytest.raises(AcceptanceError, match=message):
        ask()


def test_seven_lines_keep_the_rules(volume):
    """Seven lines, five lengths each, the longest of every line at least two thirds of the space diagonal."""
    lines = seven_lines(volume)
    diagonal = np.sqrt((volume.size**2).sum())
    assert len({line.name for line in lines}) == len(lines) == 7
    for line in lines:
        assert len(set(line.lengths)) == 5
        assert line.lengths.max() >= 2.0 / 3.0 * diagonal
        assert line.lengths.max() == pytest.approx(np.linalg.norm(line.end - line.start))
        assert np.all(np.abs([line.start, line.end]) <= volume.size / 2)
    directions = np.array([line.direction for line in lines])
    parallel = np.abs(directions @ directions.T) - np.eye(7)
    assert parallel.max() < 0.99
    ends = np.array([point for line in lines for point in (line.start, line.end)]) / volume.size
    for corner in CORNERS:  # each corner of the volume has an end near it
        assert np.linalg.norm(ends - corner, axis=1).min() < 0.1


def test_broken_rules_are_named(volume):
    lines = seven_lines(volume)
    with pytest.raises(AcceptanceError, match="6 measuring lines, at least 7"):
        require_rules(lines[:6], volume)
    few = replace(lines[0], lengths=lines[0].lengths[[0, 1, 2, 4]])
    with pytest.raises(AcceptanceError, match="line space 1: 4 different test lengths"):
        require_rules([few, *lines[1:]], volume)
    short = MeasuringLine("short", 0.5 * lines[2].start, 0.5 * lines[2].end, 0.5 * lines[2].lengths)
    with pytest.raises(AcceptanceError, match=r"line short: its longest .* two thirds"):
        require_rules([short, *lines[1:]], volume)
    outside = replace(lines[0], start=2.0 * lines[0].start)
    with pytest.raises(AcceptanceError, match="leaves the volume"):
        require_rules([outside, *lines[1:]], volume)


def test_artefact_of_a_line_carries_its_lengths(volume):
    for line in seven_lines(volume):
        body = marked_body("artefact", length_artefact(line))
        row = body.nominal[:6]
        np.testing.assert_allclose(np.linalg.norm(row[1:] - row[0], axis=1), line.lengths, atol=1e-12)
        assert set(body.sticker_ids[:6]) == {f"A{k}" for k in range(1, 7)}
        gaps = np.linalg.norm(body.nominal[:, None] - body.nominal, axis=2) + np.eye(len(body.nominal))
        assert gaps.min() > 0.018  # the dark rings do not touch


def test_ends_of_the_bar_are_bodies_of_their_own():
    bar = marked_body("bar", rigid_bar())
    first, second = bar_ends(bar)
    half = np.array([LENGTH / 2, 0.0, 0.0])
    np.testing.assert_allclose(first.nominal - half, bar.nominal[bar.nominal[:, 0] < 0])
    np.testing.assert_allclose(second.nominal + half, bar.nominal[bar.nominal[:, 0] > 0])
    for end in (first, second):
        assert len(end.nominal) == 6
        on_planes = np.einsum("ni,ni->n", end.sticker_normals, end.nominal) - end.offsets[end.plane_index]
        np.testing.assert_allclose(on_planes, 0.0, atol=1e-12)
    gaps = np.linalg.norm(bar.nominal[:, None] - bar.nominal, axis=2) + np.eye(12)
    assert gaps.min() > 0.018


def test_bar_stays_in_the_volume_starts_at_rest_and_moves_at_its_rate(volume):
    stickers = marked_body("bar", rigid_bar()).nominal
    to_volume = np.linalg.inv(volume.base_from_volume)
    paths = bar_paths(volume)
    assert len({path.name for path in paths}) == 6
    for path in paths:
        assert np.abs(path.pose_rate(0.0)).max() < 1e-2
        reached = []
        for time in np.linspace(0.0, SECONDS, 41):
            places = apply(to_volume @ pose_to_transform(path.pose(time)), stickers)
            assert np.all(np.abs(places) <= 0.5 * volume.size), (path.name, time)
            reached.append(places.mean(axis=0))
        extent = np.ptp(reached, axis=0)
        assert extent.min() > 0.1
        assert path.largest_speed > 0.3
    times = np.linspace(0.4, 0.6, 5)
    poses = np.array([paths[1].pose(time) for time in times])
    slope = np.polynomial.polynomial.polyfit(times - 0.5, poses, 4)[1]
    np.testing.assert_allclose(paths[1].pose_rate(0.5), slope, atol=2e-3)
