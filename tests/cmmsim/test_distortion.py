"""Lens distortion against OpenCV and finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmmsim.geometry.camera import Distortion, PinholeCamera

LENSES = {
    "barrel": (-0.12, 0.03, 1e-3, -7e-4, -4e-3),
    "cushion": (0.15, 0.06, -8e-4, 5e-4, 0.02),
    "moustache": (-0.2, 0.25, 3e-4, 2e-4, -0.05),
}


@pytest.fixture(params=LENSES)
def camera(request):
    lens = Distortion(*LENSES[request.param])
    return PinholeCamera(2300.0, 1020.0, 771.0, 2048, 1536, aspect=1.004, distortion=lens)


def coefficients(camera):
    lens = camera.distortion
    return np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])


def test_projection_is_that_of_opencv(camera):
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.6, -0.45, 1.4], [0.6, 0.45, 2.2], (200, 3))
    pixels, inside = camera.project(points)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, coefficients(camera))
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), rtol=0.0, atol=1e-9)
    assert inside.mean() > 0.5


def test_undistorted_pixels_are_those_of_opencv_and_project_back_with_the_jacobian_of_differences(camera):
    pixels = np.random.default_rng(2).uniform(0.0, [2047.0, 1535.0], (300, 2))
    ideal, found = camera.undistort(pixels)
    assert found.all()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # as OpenCV 4 calls it, and OpenCV 5
    lens, matrix = coefficients(camera), camera.matrix
    expected = undistort(pixels[:, None], matrix, lens, R=np.eye(3), P=matrix, criteria=criteria)
    np.testing.assert_allclose(ideal, expected.reshape(-1, 2), rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(camera.distort(ideal)[0], pixels, rtol=0.0, atol=3e-9)  # 1e-12 focal lengths
    for k, step in enumerate(1e-3 * np.eye(2)):
        slope = (camera.distort(pixels + step)[0] - camera.distort(pixels - step)[0]) / 2e-3
        np.testing.assert_allclose(camera.distortion_jacobian(pixels)[..., k], slope, atol=1e-8)


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
