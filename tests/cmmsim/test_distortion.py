"""Lens distortion against OpenCV and finite differences; calibrated cameras in sensor files."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import cmmsim
from cmmsim.files.schema import RightFromLeft
from cmmsim.files.sensor_file import read_sensor_file, sensor_text
from cmmsim.files.setup import rig_from_file
from cmmsim.geometry.camera import Distortion, PinholeCamera
from cmmsim.geometry.pose import apply, rotation_exp
from tests.cmmsim.lenses import CAMERAS

LENSES = {
    "barrel": (-0.12, 0.03, 1e-3, -7e-4, -4e-3),
    "cushion": (0.15, 0.06, -8e-4, 5e-4, 0.02),
    "moustache": (-0.2, 0.25, 3e-4, 2e-4, -0.05),
}
CALIBRATED = (
    CAMERAS
    + """
[rig.right_from_left]
translation = [-0.91, 0.01, 0.33]
rotation_vector = [0.02, -0.66, -0.01]
"""
)


def camera_of(name):
    return PinholeCamera(2300.0, 1020.0, 771.0, 2048, 1536, aspect=1.004, distortion=Distortion(*LENSES[name]))


@pytest.mark.parametrize("name", LENSES)
def test_projection_is_that_of_opencv(name):
    camera = camera_of(name)
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.6, -0.45, 1.4], [0.6, 0.45, 2.2], (200, 3))
    pixels, inside = camera.project(points)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(LENSES[name]))
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), rtol=0.0, atol=1e-9)
    assert inside.mean() > 0.5


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_pixels_are_those_of_opencv_and_project_back(name):
    camera = camera_of(name)
    pixels = np.random.default_rng(2).uniform(0.0, [2047.0, 1535.0], (300, 2))
    ideal, found = camera.undistort(pixels)
    assert found.all()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    expected = (
        cv2.undistortPointsIter(
            pixels[:, None], camera.matrix, np.array(LENSES[name]), np.eye(3), camera.matrix, criteria
        )
        if hasattr(cv2, "undistortPointsIter")
        else cv2.undistortPoints(
            pixels[:, None], camera.matrix, np.array(LENSES[name]), None, None, camera.matrix, criteria
        )
    )
    np.testing.assert_allclose(ideal, expected.reshape(-1, 2), rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(camera.distort(ideal)[0], pixels, rtol=0.0, atol=3e-9)  # 1e-12 focal lengths


@pytest.mark.parametrize("name", LENSES)
def test_jacobian_matches_finite_differences(name):
    camera = camera_of(name)
    ideal = np.random.default_rng(3).uniform(0.0, [2047.0, 1535.0], (100, 2))
    jacobian = camera.distortion_jacobian(ideal)
    for k, step in enumerate(1e-3 * np.eye(2)):
        slope = (camera.distort(ideal + step)[0] - camera.distort(ideal - step)[0]) / 2e-3
        np.testing.assert_allclose(jacobian[..., k], slope, atol=1e-8)


@given(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-3e-3, 3e-3), st.floats(-3e-3, 3e-3))
def test_every_point_within_the_fold_is_found_again_and_no_other(k1, k2, k3, p1, p2):
    lens = Distortion(k1, k2, p1, p2, k3)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    reach = min(0.97 * lens.fold_radius, 0.7)
    points = np.concatenate([share * reach * circle for share in (0.0, 0.3, 0.8, 1.0)])
    points = points[lens.holds(points)]
    distorted = lens.distort(points)
    found, ok = lens.undistort(distorted)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(lens.distort(found)[ok], distorted[ok], rtol=0.0, atol=1e-12)
    assert lens.holds(found)[ok].all()
    assert ok[np.linalg.norm(points, axis=1) < 0.85 * reach].all()


def test_beyond_the_fold_nothing_is_found_and_nothing_is_nan():
    lens = Distortion(k1=-0.3)
    assert lens.fold_radius == pytest.approx(np.sqrt(1.0 / 0.9))  # 1 + 3 k1 s = 0
    farthest = lens.fold_radius * (1.0 - 0.3 * lens.fold_radius**2)
    found, ok = lens.undistort(np.array([[0.99 * farthest, 0.0], [1.01 * farthest, 0.0], [40.0, -9.0]]))
    np.testing.assert_array_equal(ok, [True, False, False])
    assert np.isfinite(found).all()
    camera = PinholeCamera(500.0, 1000.0, 700.0, 2048, 1536, distortion=lens)
    points = np.array([[0.5, 0.0, 1.0], [1.2, 0.0, 1.0]])  # the second one folds back into the image
    pixels, valid = camera.project(points)
    assert camera.shows(pixels).all()
    np.testing.assert_array_equal(valid, [True, False])
    assert Distortion(k1=0.1).fold_radius == np.inf


def test_a_perfect_lens_takes_the_plain_path():
    camera = PinholeCamera(2300.0, 1023.5, 767.5, 2048, 1536)
    pixels = np.random.default_rng(4).uniform(0.0, 1500.0, (5, 2))
    assert camera.ideal is camera
    assert camera.undistort(pixels)[0] is pixels


def test_sensor_file_with_calibrated_cameras(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(sensor_text("ctrack780") + CALIBRATED, encoding="utf-8")
    rig = cmmsim.load_sensor(path).rig
    np.testing.assert_allclose(rig.left.matrix, [[2295.0, 0, 1017.2], [0, 2301.5, 771.9], [0, 0, 1]])
    assert rig.left.distortion == Distortion(-0.11, 0.07, 4e-4, -3e-4, 0.0)
    assert rig.right.distortion.is_zero
    point = np.array([0.1, -0.2, 1.7])
    np.testing.assert_allclose(
        apply(rig.right_from_left, point),
        rotation_exp(np.array([0.02, -0.66, -0.01])) @ point + [-0.91, 0.01, 0.33],
        atol=1e-15,
    )
    assert np.all(rig.left.project(np.array([[0.0, 0.0, 1.8]]))[1])


def test_calibrated_rig_stands_where_the_toed_in_one_does():
    """The toed-in rig written as a calibrated one is put at the same place."""
    section = read_sensor_file("ctrack780").rig
    rig, camera_from_base = rig_from_file(section)
    rotation = cv2.Rodrigues(rig.right_from_left[:3, :3])[0].ravel()
    again = section.model_copy(
        update={
            "right_from_left": RightFromLeft(
                translation=tuple(rig.right_from_left[:3, 3]), rotation_vector=tuple(rotation)
            )
        }
    )
    same, place = rig_from_file(again)
    np.testing.assert_allclose(same.right_from_left, rig.right_from_left, atol=1e-14)
    np.testing.assert_allclose(place, camera_from_base, atol=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[2295.0, 2301.5]", "[2295.0, -1.0]", "rig.left.focal_px.1: .*greater than 0"),
        ("-3e-4, 0.0]", "-3e-4]", "rig.left.distortion.4: Field required"),
        ("-0.11, 0.07", "-3.0, 0.0", r"rig.left.distortion: the image folds back before pixel \[.*focal lengths"),
        ("-0.91, 0.01, 0.33", "0.91, 0.01, 0.33", "right camera must stand on the right"),
        ("-0.91, 0.01, 0.33", "0.0, 0.0, 0.0", "at least 0.001 m apart"),
        ("translation", "shift", "unknown key 'rig.right_from_left.shift', valid are rotation_vector, translation"),
        ("centre_px = [1017.2, 771.9]", "centre_px = [nan, 771.9]", "rig.left.centre_px.0: .*finite"),
    ],
)
def test_bad_calibration_in_a_sensor_file(tmp_path, old, new, message):
    path = tmp_path / "mine.toml"
    assert old in CALIBRATED
    path.write_text(sensor_text("ctrack780") + CALIBRATED.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(cmmsim.SensorFileError, match=message):
        cmmsim.load_sensor(path)
