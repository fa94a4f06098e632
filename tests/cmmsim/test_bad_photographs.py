"""What is wrong with photographs is said in one line: exchanged folders, pairs that do not belong
together, stickers that moved.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import cmmsim
from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.errors import LostError
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.photographs import bundle, photographed_teaching, rejection
from cmmsim.photographs.pairs import Photograph
from tests.cmmsim.photographed import spread_poses
from tests.cmmsim.sensors import refused

COUNT = 8


@dataclass(frozen=True)
class Spots:
    """An exposure that is the ellipses in both images."""

    sides: tuple[EllipseFits, EllipseFits]

    def bright(self, observer):
        return self.sides

    def detected(self, corners, size, observer):
        raise NotImplementedError


def load(changes=None):
    return cmmsim.load_sensor("ctrack780", renderer="statistical", seed=2, changes=changes)


def spots(sensor, poses, observer):
    return [sensor.look(pose).bright(observer) for pose in poses]


def teach(sensor, pairs):
    return sensor.teach_from(
        Photograph(f"{k:02d}.png", 0.1 * k, Spots(pair)) for k, pair in enumerate(pairs)
    )


@pytest.fixture(scope="module")
def sensor():
    return load()


@pytest.fixture(scope="module")
def good(sensor):
    return spots(sensor, spread_poses(COUNT, 4), sensor.observer)


def moved(body, plane, sticker, shift):
    """Changes of the sensor file that put a sticker elsewhere on its plane."""
    planes = getattr(read_sensor_file("ctrack780"), body).planes
    listed = [list(place) for place in getattr(planes, plane).stickers]
    listed[sticker][0] += shift
    return {f"{body}.planes.{plane}.stickers": listed}


def without(pair, gone):
    """The spots of a pair without those in parts of the right image (x, y, px)."""
    left, right = pair
    near = np.linalg.norm(right.centres[:, None] - gone, axis=2).min(axis=1) < 20.0
    return left, type(right)(*(values[~near] for values in vars(right).values()))


def cause(sensor, pairs):
    with pytest.raises(cmmsim.TeachingError) as error:
        teach(sensor, pairs)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_folders_that_are_exchanged_or_shifted_or_of_one_camera_are_said_to_be(sensor, good):
    exchanged = [(right, left) for left, right in good]
    assert "left and right are exchanged" in cause(sensor, exchanged)
    later = [(good[k][0], good[k + 1][1]) for k in range(COUNT - 1)]
    assert "the first 1 of the left folder, from 00.png on" in cause(sensor, later)
    earlier = [(good[k + 1][0], good[k][1]) for k in range(COUNT - 1)]
    assert "the first 1 of the right folder" in cause(sensor, earlier)
    again = spots(sensor, spread_poses(COUNT, 4), sensor.observer)
    same = [(one[0], two[0]) for one, two in zip(good, again, strict=True)]
    assert "are both folders of one camera?" in cause(sensor, same)


def test_folders_in_another_order_are_said_not_to_belong_together(sensor, good):
    mixed = [(good[k][0], good[(k + 3) % COUNT][1]) for k in range(COUNT)]
    said = cause(sensor, mixed)
    assert "both images of a pair, such as 00.png, show about 3" in said
    assert "do the images of a pair belong together" in said


def test_a_pair_whose_images_do_not_belong_together_is_left_out_and_named(sensor, good):
    pairs = [*good]
    pairs[2] = good[2][0], good[5][1]
    found = teach(sensor, pairs)
    assert list(found.rejected_pairs) == ["02.png"]
    assert "do not belong together" in found.rejected_pairs["02.png"]
    assert any("02.png" in line for line in found.warnings)
    assert len(found.taught.platform_places) == 18


@pytest.mark.parametrize(
    ("body", "plane", "sticker", "shift"),
    [
        ("platform", "B", 2, 4e-4),
        ("platform", "A", 0, 6e-3),
        ("base", "C", 1, 2e-4),
        ("base", "B", 4, 6e-3),
    ],
)
def test_a_sticker_that_moved_between_pairs_is_left_out_and_measured_without(
    sensor, good, body, plane, sticker, shift
):
    other = load(moved(body, plane, sticker, shift))
    poses = spread_poses(COUNT, 4)
    pairs = [*good[:4], *spots(other, poses[4:], sensor.observer)]
    found = teach(sensor, pairs)
    name = f"{plane}{sticker + 1} of the {body}"
    assert list(found.rejected_stickers) == [name]
    said = found.rejected_stickers[name]
    assert said.startswith("moved by ")
    assert float(said.split()[2]) == pytest.approx(1e3 * shift, abs=0.03)
    assert "between 03.png and 04.png" in said
    assert not found.rejected_pairs
    taught = cmmsim.load_sensor("ctrack780", renderer="statistical", taught=found.taught)
    measured = taught.measure_many(spread_poses(50, 9, 0.009, 0.035))
    errors = measured.poses - spread_poses(50, 9, 0.009, 0.035)
    spread = measured.covariances + taught.estimator.common_at(taught.home)
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(spread), errors)
    assert squares.mean() < 22.5
    one = taught.measure(taught.home)
    assert one.ok
    assert (f"{plane}{sticker + 1}" in one.target_ids) == (body == "base")


@pytest.mark.parametrize("rounds", [1, 40])
def test_a_centre_that_is_left_out_takes_no_part_in_the_result(sensor, good, rounds, monkeypatch):
    monkeypatch.setattr(rejection, "ROUNDS", rounds)
    left, right = good[2]
    wrong = left.centres.copy()
    wrong[0] += (0.6, 0.0)
    found = teach(sensor, [*good[:2], (replace(left, centres=wrong), right), *good[3:]])
    used = len(teach(sensor, good).observations.pair)
    assert len(found.observations.pair) == len(found.bundle.squares) == used - 1


def test_an_adjustment_that_does_not_converge_fails(sensor, good):
    found = teach(sensor, good)
    far = replace(found.bundle.state, places=2.0 * found.bundle.state.places)
    refused(
        lambda: bundle.adjust(found.observations, far, sensor.rig, np.zeros((24, 24))),
        r"has not converged in 12 steps: the last one moves a sticker by [\d.e+]+ mm",
        LostError,
    )


def test_a_sensor_can_be_taught_again_after_it_lacked_a_sticker(good):
    sensor, other = load(), load(moved("platform", "A", 0, 6e-3))
    poses = spread_poses(COUNT, 4)
    pairs = [*good[:4], *spots(other, poses[4:], sensor.observer)]
    assert len(sensor.teach(frames=map(Spots, pairs)).platform_places) == 17
    assert len(sensor.platform.sticker_ids) == 17
    assert len(sensor.teach(frames=map(Spots, good)).platform_places) == 18
    assert len(sensor.platform.sticker_ids) == 18


def test_of_very_many_pairs_some_are_used(sensor, good, monkeypatch):
    monkeypatch.setattr(photographed_teaching, "MOST_PAIRS", 5)
    found = teach(sensor, good)
    assert found.pairs == ("00.png", "01.png", "03.png", "05.png", "07.png")
    assert found.warnings == ("3 pairs are not used: 5 pairs, spread over all, are enough",)


def test_a_plane_with_fewer_than_three_stickers_is_named(sensor, good):
    truth, home = sensor.truth, spread_poses(COUNT, 4)
    four = np.flatnonzero(sensor.platform.plane_index == 2)[:4]
    pairs = []
    for pair, pose in zip(good, home, strict=True):
        places = apply(
            invert(truth.base_from_camera) @ pose_to_transform(pose), truth.platform_places[four]
        )
        pairs.append(without(pair, sensor.rig.project(places)[0][1]))
    said = cause(sensor, pairs)
    assert "platform: plane C has 2 stickers that can be used, but at least 3 are needed" in said
    assert "C1 of the platform found in 0 of 8 pairs near its rough position" in said


def test_images_without_spots_and_a_platform_that_stands_are_reported(sensor, good):
    nothing = without(good[0], good[0][1].centres)
    said = cause(sensor, [nothing] * 3)
    assert "no bright spots in both images of any of 3 pairs" in said
    assert "bright discs, because stickers.sticker_level is above stickers.ring_level" in said
    assert "2 pairs, but at least 3 needed" in cause(sensor, good[:2])
    still = spots(sensor, [sensor.home] * 4, sensor.observer)
    assert any("the platform moves by at most 0." in one for one in teach(sensor, still).warnings)
