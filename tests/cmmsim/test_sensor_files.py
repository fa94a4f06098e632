"""Sensor files: what they may hold, what they are based on, and how what is wrong in them is named
in one line.
"""

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.schema import RightFromLeft
from cmmsim.files.sensor_file import read_sensor_file, sensor_text
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.pose import apply, rotation_exp
from tests.cmmsim.sensors import LEFT, RIGHT, refused

BESIDE = {"translation": [-0.91, 0.01, 0.33], "rotation_vector": [0.02, -0.66, -0.01]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # what the schema refuses: a key, a type, a range, a number
        ({"camera.darknoise": 26.0}, "unknown key 'camera.darknoise', valid are .*dark_noise"),
        ({"rig.baseline": "wide"}, "rig.baseline: .*number.*'wide'"),
        (
            {"rig.baseline": -1.0},
            "rig.baseline: -1 is out of range, must be 1e-06 to 1000 m",
        ),
        ({"camera.dsnu": float("nan")}, "camera.dsnu: .*finite"),
        ({"camera.bit_depth": 9}, "camera.bit_depth: .*8, 10, 12, 14 or 16.*9"),
        (
            {"rig.left": LEFT | {"distortion": [0.1, 0.0, 0.0, 0.0]}},
            "rig.left.distortion.4: Field required",
        ),
        (
            {"detection.detector": "hough"},
            "detection.detector: unknown detector 'hough': valid are dual_.* or m",
        ),
        (
            {"renderer": "blender"},
            "renderer: unknown renderer 'blender': valid are analytic, auto, mitsuba, pyren",
        ),
        # what contradicts itself
        ({"camera.black_level": 256.0}, "camera: .*black_level 256 must lie below .* 255"),
        ({"lens.psf_px": 0.0999}, "lens: .*psf_px 0.0999 must be 0 or at least 0.1 px"),
        (
            {"timing.latency": 0.01, "timing.latency_jitter": 0.02},
            "timing: latency_jitter 0.02 s is larger than lat",
        ),
        (
            {"timing.exposure": 0.02},
            "timing: exposure 0.02 s is longer than the frame period at 60 Hz, 0.01667 s$",
        ),
        (
            {"stickers.placement": [0.002, 0.001]},
            r"placement \[0.002, 0.001\] m must be the smallest and the largest",
        ),
        ({"stickers.ring_radius": 0.002}, "ring_radius 0.002 m must be at least radius 0.003 m"),
        ({"stickers.sticker_level": 8}, "sticker_level 8 must not be ring_level"),
        (
            {"stickers.per_plane": 50},
            r"per_plane = 50, stickers on plane A are 0\.0\d+ m apart.* 0\.018 m",
        ),
        # what no body and no rig can be
        (
            {"platform.planes.A.stickers": [[1, 0], [2, 0], [3, 0]]},
            "platform: the middle of its stickers.*outside of",
        ),
        ({"platform.cuts": []}, "platform: its planes and cuts enclose no solid"),
        ({"platform.planes.B.normal": [0, 0, 0]}, r"must not be zero, got \[0.0, 0.0, 0.0\]"),
        (
            {"rig.left": LEFT | {"distortion": [-3.0, 0, 0, 0, 0]}},
            r"rig.left.distortion: the image folds back before",
        ),
        (
            {"rig.right_from_left": BESIDE | {"translation": [0.91, 0.01, 0.33]}},
            "right camera must stand to the right",
        ),
        (
            {"rig.right_from_left": BESIDE | {"translation": [0.0, 0.0, 0.0]}},
            "at least 0.001 m apart",
        ),
        # what no change can be
        ({3: 4}, "key 3 of the changes is not a text"),
        ([1], r"changes = \[1\] must be a mapping of keys"),
        ({"based_on": "nothing"}, "based_on = 'nothing' cannot be changed"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(changes, message):
    refused(lambda: cmmsim.load_sensor("ctrack780", changes=changes), message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bytes(range(256)), "mine.toml is not text"),
        (b"[camera", "sensor file .*mine.toml"),
        # one level only: neither a chain nor a circle
        (b'based_on = "ctrack78"', r"mine.toml: based_on: unknown sensor .*ctrack78.*ctrack780"),
        (
            b'based_on = "mine.toml"',
            "is itself based on 'mine.toml': name a sensor with a complete file",
        ),
        (b'based_on = "ctrack780_29hz"', "is itself based on 'ctrack780'"),
        (b"based_on = 3", "based_on: Input should be a valid string"),
    ],
)
def test_a_file_that_is_no_toml_or_has_a_bad_basis_is_refused(tmp_path, content, message):
    (tmp_path / "mine.toml").write_bytes(content)
    refused(lambda: read_sensor_file(tmp_path / "mine.toml"), message, cmmsim.SensorFileError)


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("ctrak", cmmsim.UnknownSensorError, "'ctrak'.*ctrack780"),
        ("x" * 5000, cmmsim.SensorFileError, "cannot read sensor file xxx.*: File name too long"),
        (
            None,
            cmmsim.CmmError,
            "a sensor must be .* name or the path .*, got None of type NoneType",
        ),
    ],
)
def test_what_names_no_file_is_refused(name, kind, message):
    with pytest.raises(kind, match=message):
        cmmsim.load_sensor(name)


def test_a_file_is_read_from_a_path_and_may_change_single_entries_of_the_one_beside_it(tmp_path):
    (tmp_path / "base.toml").write_text(
        sensor_text("ctrack780").replace("gain = 0.13", "gain = 0.26")
    )
    mine = tmp_path / "mine.toml"
    mine.write_text(
        'name = "mine"\nbased_on = "base.toml"\n[camera]\ndark_noise = 3.0\n[lens]\npsf_px = 0.5\n'
    )
    found = read_sensor_file(mine)
    assert (found.name, found.camera.gain, found.camera.dark_noise, found.lens.psf_px) == (
        "mine",
        0.26,
        3.0,
        0.5,
    )
    assert found.rig == read_sensor_file("ctrack780").rig
    assert cmmsim.load_sensor(mine).noise.gain == 0.26


def test_a_short_file_completes_planes_and_no_other_tables_within_tables(tmp_path):
    mine, usual = tmp_path / "mine.toml", read_sensor_file("ctrack780").platform.planes
    head = 'name = "mine"\nbased_on = "ctrack780"\n'
    mine.write_text(f"{head}[platform.planes.A]\nstickers = {[*map(list, usual.A.stickers[:5])]}\n")
    planes = read_sensor_file(mine).platform.planes
    five = usual.A.model_copy(update={"stickers": usual.A.stickers[:5]})
    assert planes == usual.model_copy(update={"A": five})
    mine.write_text(f"{head}[rig.left]\ncentre_px = [1000.0, 700.0]\n")
    refused(lambda: read_sensor_file(mine), "rig.left.focal_px: Field required")


def test_the_camera_tables_of_a_calibration_are_told_from_the_whole_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text("[rig.left]\nfocal_px = [1400.0, 1400.0]\n")
    said = "has only the table of the cameras; {} the whole file"
    refused(lambda: read_sensor_file(path), said.format("cmmsim calibrate --sensor NAME writes"))
    (tmp_path / "sensor.toml").touch()
    refused(lambda: read_sensor_file(path), said.format(f"{tmp_path / 'sensor.toml'} is"))


def test_the_29_hz_sensor_is_labelled_as_assumed_and_differs_in_nothing_but_its_timing():
    slow, usual = read_sensor_file("ctrack780_29hz"), read_sensor_file("ctrack780")
    assert (slow.timing.frame_rate, slow.timing.latency * slow.timing.frame_rate) == (29.0, 1.0)
    assert "assumed" in cmmsim.load_sensor("ctrack780_29hz").note
    assert usual.note == ""
    own = {"name", "based_on", "note", "timing"}
    assert slow.model_dump(exclude=own) == usual.model_dump(exclude=own)


def test_a_resolved_file_reads_back_as_itself():
    file = read_sensor_file("ctrack780", {"rig.distance": 2.0, "stickers.per_plane": 5})
    assert type(file).model_validate_json(file.model_dump_json()) == file


@pytest.mark.parametrize("count", [3, 4, 7, 18])
def test_stickers_of_any_number_have_the_middle_of_those_listed_and_half_their_variance(count):
    changes = {"stickers.per_plane": count, "stickers.ring_radius": 0.006}
    found = dict(read_sensor_file("ctrack780", changes).platform.planes)
    for name, plane in read_sensor_file("ctrack780").platform.planes:
        listed, ring = np.array(plane.stickers), np.array(found[name].stickers)
        assert ring.shape == (count, 2)
        np.testing.assert_allclose(ring.mean(axis=0), listed.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(
            np.cov(ring.T, bias=True), 0.5 * np.cov(listed.T, bias=True), atol=1e-12
        )


def test_distance_moves_the_rig_along_its_line_of_sight():
    near, far = (
        read_sensor_file("ctrack780", changes).rig for changes in ({}, {"rig.distance": 3.0})
    )
    towards = [np.subtract(rig.position, rig.target) for rig in (near, far)]
    assert np.linalg.norm(towards[1]) == pytest.approx(3.0, abs=1e-12)
    np.testing.assert_allclose(
        towards[1] / 3.0, towards[0] / np.linalg.norm(towards[0]), atol=1e-12
    )
    assert far.target == near.target


def test_calibrated_cameras_stand_and_see_as_the_file_says():
    rig = cmmsim.load_sensor(
        "ctrack780", changes={"rig.left": LEFT, "rig.right": RIGHT, "rig.right_from_left": BESIDE}
    ).rig
    np.testing.assert_allclose(
        rig.left.matrix, [[2295.0, 0, 1017.2], [0, 2301.5, 771.9], [0, 0, 1]]
    )
    assert rig.left.distortion == Distortion(-0.11, 0.07, 4e-4, -3e-4, 0.0)
    assert rig.right.distortion.is_zero
    point = np.array([0.1, -0.2, 1.7])
    expected = rotation_exp(np.array(BESIDE["rotation_vector"])) @ point + BESIDE["translation"]
    np.testing.assert_allclose(apply(rig.right_from_left, point), expected, atol=1e-15)
    assert np.all(rig.left.project(np.array([[0.0, 0.0, 1.8]]))[1])


def test_a_calibrated_rig_stands_where_the_toed_in_one_does():
    """The toed-in rig written as a calibrated one is put at the same place."""
    section = read_sensor_file("ctrack780").rig
    rig, camera_from_base = rig_from_file(section)
    rotation = cv2.Rodrigues(rig.right_from_left[:3, :3])[0].ravel()
    beside = RightFromLeft(
        translation=tuple(rig.right_from_left[:3, 3]), rotation_vector=tuple(rotation)
    )
    same, place = rig_from_file(section.model_copy(update={"right_from_left": beside}))
    np.testing.assert_allclose(same.right_from_left, rig.right_from_left, atol=1e-14)
    np.testing.assert_allclose(place, camera_from_base, atol=1e-14)
