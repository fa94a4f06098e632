"""Volume, lines and paths of the acceptance tests by geometry; statistics and latency of series of
known truth.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import cmmsim
from cmmsim.acceptance import (
    AcceptanceError,
    bar_paths,
    common_volume,
    estimate_latency,
    interval_of_mean,
    require_rules,
    seven_lines,
    summarise,
    volume_of_size,
)
from cmmsim.acceptance.artefacts import bar_ends, rigid_bar
from cmmsim.acceptance.latency_test import require_room
from cmmsim.acceptance.moving_bar import SECONDS
from cmmsim.acceptance.volume import CORNERS, MARGIN_PX, MeasuringLine
from cmmsim.files.rig_and_bodies import marked_body, rig_from_file
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, pose_to_transform

RIG = read_sensor_file("ctrack780").rig


def test_volume_is_the_largest_that_both_cameras_see_along_their_axes(volume):
    """x goes right and y down in both images, and what is further away is smaller."""
    rig, camera_from_base = rig_from_file(RIG)
    pixels = rig.project(apply(camera_from_base @ volume.base_from_volume, CORNERS * volume.size))[
        0
    ]
    room = np.minimum(pixels, np.array([RIG.width, RIG.height]) - 1 - pixels)
    assert room.min() >= MARGIN_PX
    assert room.min() < MARGIN_PX + 3.0  # a millimetre more would be too much
    place, turn = volume.base_from_volume[:3, 3], volume.base_from_volume[:3, :3]
    np.testing.assert_allclose(place, RIG.target)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    distance = np.linalg.norm(np.subtract(RIG.target, RIG.position))
    assert volume.depth_range == pytest.approx(
        (distance - volume.size[2] / 2, distance + volume.size[2] / 2)
    )
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
            r"2000 x 500 x 500 mm is not wh.*corner \(-1000, .*px.*largest visible cube.*682 mm",
        ),
        (lambda: sized(0.5, 0.5, 3.0), r"front face comes within \d+ mm"),
        (lambda: sized(0.5, 0.05, 0.5), "at least 100 mm"),
        (lambda: sized(0.5, np.nan, 0.5), "three sides"),
        # cameras that look away from each other, so that no point is in both images
        (
            lambda: common_volume(RIG.model_copy(update={"focal_px": 6e4})),
            "nothing is visible to both cameras",
        ),
        (lambda: seven_lines(sized(0.6, 0.3, 0.3)), r"two thirds.*nearer to a cube"),
        (
            lambda: bar_paths(sized(0.3, 0.3, 0.3)),
            r"raster x, bar along x: the bar needs .* the volume has 300 x 300",
        ),
        (lambda: require_room(sized(0.3, 0.3, 0.3)), "body on its circle needs"),
    ],
)
def test_volumes_that_cannot_be_or_hold_too_little_are_refused(ask, message):
    with pytest.raises(AcceptanceError, match=message):
        ask()


def test_seven_lines_keep_the_rules(volume):
    """Seven lines, five lengths each, the longest of every line at least two thirds of the space
    diagonal.
    """
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
    first, *others = seven_lines(volume)
    long = others[1]
    for changed, message in (
        ([], "6 measuring lines, but at least 7"),
        (
            [replace(first, lengths=first.lengths[[0, 1, 2, 4]])],
            "line space 1: 4 different test lengths",
        ),
        (
            [MeasuringLine("short", long.start / 2, long.end / 2, long.lengths / 2)],
            "line short: its longest .* two th",
        ),
        ([replace(first, start=2.0 * first.start)], "leaves the volume"),
    ):
        with pytest.raises(AcceptanceError, match=message):
            require_rules([*changed, *others], volume)


def test_ends_of_the_bar_are_bodies_of_their_own():
    for end in bar_ends(marked_body("bar", rigid_bar())):
        assert len(end.nominal) == 6
        on_planes = (
            np.einsum("ni,ni->n", end.sticker_normals, end.nominal) - end.offsets[end.plane_index]
        )
        np.testing.assert_allclose(on_planes, 0.0, atol=1e-12)


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


def test_statistics_of_known_values_and_of_none():
    """1 to 100: mean 50.5, mean square 101 * 201 / 6, largest 100; Student's t with two values:
    12.706 times half of their distance."""
    found = summarise(np.arange(1.0, 101.0), np.random.default_rng(0))
    assert (found.count, found.mean, found.maximum) == (100, 50.5, 100.0)
    assert found.rms == pytest.approx(np.sqrt(101 * 201 / 6))
    assert found.p95 == pytest.approx(95.05)
    assert interval_of_mean(np.array([1.0, 3.0])) == pytest.approx(
        (2.0 - 12.7062, 2.0 + 12.7062), rel=1e-5
    )
    with pytest.raises(cmmsim.ShapeError, match="two values"):
        interval_of_mean(np.array([1.0]))
    for values in (np.zeros(0), np.array([1.0, np.nan]), np.zeros((2, 2))):
        with pytest.raises(cmmsim.ShapeError, match="finite values"):
            summarise(values, np.random.default_rng(0))


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """Half-normal errors: mean sqrt(2/pi), rms 1, 95th percentile the 97.5 % point of the normal
    distribution.
    """
    truth = {"mean": np.sqrt(2.0 / np.pi), "rms": 1.0, "p95": norm.ppf(0.975)}
    rng = np.random.default_rng(1)
    held = dict.fromkeys(truth, 0)
    for _ in range(200):
        found = summarise(np.abs(rng.standard_normal(200)), rng)
        for name, value in truth.items():
            held[name] += found.interval[name][0] <= value <= found.interval[name][1]
    assert all(0.88 < count / 200 < 0.99 for count in held.values()), held


def test_blocks_widen_the_interval_of_dependent_values():
    """Each value ten times in a row: the interval must be that of the different values, sqrt(10)
    times wider.
    """
    rng = np.random.default_rng(2)
    values = np.abs(rng.standard_normal(200))
    widths = []
    for series, block in ((values, 1), (np.repeat(values, 10), 1), (np.repeat(values, 10), 10)):
        low, high = summarise(series, np.random.default_rng(3), block).interval["mean"]
        widths.append(high - low)
    assert widths[1] == pytest.approx(widths[0] / np.sqrt(10.0), rel=0.15)
    assert widths[2] == pytest.approx(widths[0], rel=0.25)


def ellipse(times):
    """A motion that never stands still, and is at a place only once a second."""
    angle = 2.0 * np.pi * times
    return np.column_stack([0.05 * np.cos(angle), 0.08 * np.sin(angle), 0.01 * np.sin(angle)])


def reports(delays, noise, rng, shift=(0.0, 0.0, 0.0)):
    taken = np.arange(len(delays)) / 60.0
    return taken + delays, ellipse(taken) + shift + noise * rng.standard_normal((len(delays), 3))


def test_known_latency_is_found_within_its_interval():
    """14.2 ms under 10 um of noise and a constant offset: in the interval in 95 of 100 series,
    exact on average.
    """
    means, held = [], 0
    for seed in range(100):
        reported, positions = reports(
            np.full(120, 0.0142), 1e-5, np.random.default_rng(seed), (1e-3, -2e-3, 5e-4)
        )
        found = estimate_latency(
            reported, positions, ellipse, 0.5, np.tile(1e-10 * np.eye(3), (120, 1, 1))
        )
        means.append(found.mean)
        held += found.interval[0] <= 0.0142 <= found.interval[1]
        assert found.std == pytest.approx(found.resolution, rel=0.35)
    assert 88 <= held <= 100
    spread = np.std(means) / 10.0
    assert abs(np.mean(means) - 0.0142) < 4.0 * spread
    assert spread < 1e-6


def test_noise_free_latency_is_exact_and_needs_a_motion():
    for latency in (0.0, 0.004, 0.1, 0.45):
        found = estimate_latency(
            *reports(np.full(60, latency), 0.0, np.random.default_rng(0)), ellipse, 0.5
        )
        assert found.mean == pytest.approx(latency, abs=1e-9)
        assert found.std < 1e-9
    times = np.arange(10) / 60.0
    with pytest.raises(cmmsim.ShapeError, match="without standstill"):
        estimate_latency(times, np.zeros((10, 3)), lambda t: np.zeros((len(t), 3)), 0.5)
    with pytest.raises(cmmsim.ShapeError, match="four reports"):
        estimate_latency(times[:3], np.zeros((3, 3)), ellipse, 0.5)
