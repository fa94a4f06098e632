"""Poses, lenses, triangulation, plane frames and registration against closed forms, SciPy and
OpenCV.
"""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cmmsim.errors import LostError, ShapeError
from cmmsim.geometry import pose as p
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.plane_frame import (
    fit_plane,
    frame_from_planes,
    frame_of_points,
    frames_of_points,
)
from cmmsim.geometry.registration import register, register_sets
from cmmsim.geometry.stereo_rig import toed_in_rig
from cmmsim.geometry.triangulation import triangulate
from tests.cmmsim.sensors import CAMERA

ANGLE = st.floats(-1.4, 1.4)
RIG, CAMERA_FROM_BASE = toed_in_rig(
    CAMERA, 1.0, np.array([1.44, 0.0, 1.28]), np.array([0.3, 0.0, 0.18])
)


@settings(deadline=None)  # the first one loads kernels
@given(ANGLE, ANGLE, ANGLE)
def test_rotation_is_the_paper_order_and_round_trips(alpha, beta, gamma):
    pose = np.array([0.1, -0.2, 0.3, alpha, beta, gamma])
    transform = p.pose_to_transform(pose)
    expected = Rotation.from_euler("XYZ", [alpha, beta, gamma]).as_matrix()
    np.testing.assert_allclose(transform[:3, :3], expected, atol=1e-14)
    np.testing.assert_allclose(p.transform_to_pose(transform), pose, atol=1e-12)


@given(st.floats(0.0, 2.5), ANGLE, ANGLE)
def test_rotation_vector_round_trips(size, azimuth, elevation):
    vector = size * np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    rotation = p.rotation_exp(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(p.rotation_log(rotation), vector, atol=1e-8)


@pytest.mark.parametrize(
    "spoil", [None, "entry", "nan", "infinite", "mirror", "transpose", "scale"]
)
def test_transforms_are_told_rigid_together_where_each_passes_its_own_check(spoil):
    """The check of a single one is NumPy, and says what is wrong."""
    rng = np.random.default_rng(0)
    for size in (1e-7, 4e-7, 1e-6, 2e-6, 1e-3):
        for row, column in np.ndindex(4, 4):
            together = np.array([p.pose_to_transform(rng.uniform(-3, 3, 6)) for _ in range(3)])
            one = together[rng.integers(3)]
            if spoil in ("entry", "nan", "infinite"):
                one[row, column] += {"entry": size, "nan": np.nan, "infinite": -np.inf}[spoil]
            elif spoil is not None:
                flip = np.diag([1.0, -1.0, 1.0, 1.0])
                grown = np.diag([1 + size, 1 + size, 1 + size, 1.0])
                one[:] = {"mirror": flip @ one, "transpose": one.T, "scale": grown @ one}[spoil]
            passes = True
            for each in together:
                try:
                    p.checked_transform(each)
                except ShapeError:
                    passes = False
            assert p.all_rigid(together) == passes, together


def test_euler_rates_match_finite_differences():
    pose = np.array([0.0, 0.0, 0.0, 0.4, -0.7, 1.1])
    matrix = p.euler_rates_matrix(pose)
    for k in range(3):
        step = np.zeros(6)
        step[3 + k] = 1e-6
        turn = Rotation.from_matrix(
            p.pose_to_transform(pose + step)[:3, :3] @ p.pose_to_transform(pose - step)[:3, :3].T
        )
        np.testing.assert_allclose(turn.as_rotvec() / 2e-6, matrix[:, k], atol=1e-7)


def test_plane_frame_of_exact_points():
    """Three planes built from a known frame give it back, seen from anywhere."""
    normals, corner = (
        np.array([[0.0, 0.0, 1.0], [0.8, 0.5, 0.3], [0.8, -0.5, 0.2]]),
        np.array([0.19, 0.02, 0.13]),
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    own = frame_from_planes(normals, normals @ corner)
    np.testing.assert_allclose(own[:3, 3], corner, atol=1e-14)
    np.testing.assert_allclose(own[:3, 2], normals[0], atol=1e-14)
    np.testing.assert_allclose(normals[:2] @ own[:3, 0], 0.0, atol=1e-14)
    plane, spread = np.repeat(np.arange(3), 5), np.random.default_rng(2).uniform(-0.1, 0.1, (15, 3))
    points = (
        corner + spread - np.einsum("ni,ni->n", spread, normals[plane])[:, None] * normals[plane]
    )
    moved, covariances = (
        p.pose_to_transform([0.1, -0.2, 1.7, 1.8, -0.9, 0.4]),
        np.tile(1e-10 * np.eye(3), (15, 1, 1)),
    )
    frame, _ = frame_of_points(
        p.apply(moved, points), covariances, plane, normals @ moved[:3, :3].T
    )
    np.testing.assert_allclose(frame, moved @ own, atol=1e-12)


def test_covariance_of_a_plane_frame_is_what_errors_of_its_points_make():
    """To first order, by differences of the whole fit: each coordinate of each point moved forth
    and back.
    """
    rng, step, std = np.random.default_rng(7), 1e-6, 2e-5
    normals = np.array([[0.0, 0.1, 1.0], [0.8, 0.5, 0.3], [0.7, -0.6, 0.2]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    plane, spread = np.repeat(np.arange(3), 4), rng.uniform(-0.1, 0.1, (12, 3))
    points = (
        np.array([0.2, -0.1, 1.5])
        + spread
        - np.einsum("ni,ni->n", spread, normals[plane])[:, None] * normals[plane]
    )
    covariances = np.tile(std**2 * np.eye(3), (12, 1, 1))

    def frame(moved):
        return frame_of_points(moved, covariances, plane, normals)

    changes = []
    for k in range(points.size):
        by = step * np.eye(1, points.size, k).reshape(points.shape)
        more, less = frame(points + by)[0], frame(points - by)[0]
        turn = Rotation.from_matrix(more[:3, :3] @ less[:3, :3].T).as_rotvec()
        changes.append(np.concatenate([more[:3, 3] - less[:3, 3], turn]) / (2 * step))
    expected = std**2 * np.transpose(changes) @ changes
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(frame(points)[1] / scale, expected / scale, atol=1e-6)


@settings(max_examples=50, deadline=None)  # the first one may compile
@given(st.integers(0, 10_000), st.integers(3, 18))
def test_registration_finds_a_known_transform(seed, count):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-0.2, 0.2, (count, 3))
    rotation, shift = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    spread = rng.normal(size=(count, 3, 3))
    covariances = spread @ spread.transpose(0, 2, 1) + 0.1 * np.eye(3)
    if np.linalg.svd(source - source.mean(axis=0), compute_uv=False)[1] < 0.02:
        return
    found = register(source, source @ rotation.T + shift, covariances)
    np.testing.assert_allclose(found.transform[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(found.transform[:3, 3], shift, atol=1e-9)


@pytest.fixture(scope="module")
def seen():
    """Noisy pixels (2, n, 2) of points with their covariances (2, n, 2, 2)."""
    rng = np.random.default_rng(0)
    points = rng.uniform([0.3, -0.2, 1.3], [0.7, 0.2, 1.7], (12, 3))
    half = rng.normal(size=(2, 12, 2, 2))
    covariances = 1e-4 * (half @ half.transpose(0, 1, 3, 2) + np.eye(2))
    return RIG.project(points)[0] + 0.02 * rng.normal(size=(2, 12, 2)), covariances


def test_points_explain_their_pixels_best(seen):
    pixels, covariances = seen
    found = triangulate(RIG, *pixels, *covariances)
    roots = np.linalg.inv(np.linalg.cholesky(covariances))
    for n in range(pixels.shape[1]):

        def whitened(point, n=n):
            return np.einsum(
                "kij,kj->ki", roots[:, n], RIG.project(point[None])[0][:, 0] - pixels[:, n]
            ).ravel()

        best = least_squares(
            whitened, found.points[n] + 1e-4, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(found.points[n], best.x, atol=2e-9)
        np.testing.assert_allclose(
            found.covariances[n], np.linalg.inv(best.jac.T @ best.jac), rtol=1e-4, atol=1e-13
        )
        assert found.ray_gap[n] == pytest.approx(2.0 * best.cost, rel=1e-4)


def test_transform_explains_the_points_best(seen):
    pixels, covariances = seen
    target = triangulate(RIG, *pixels, *covariances)
    source = target.points @ p.rotation_exp(np.array([0.4, -0.8, 0.3])) + [0.1, 0.2, -0.3]
    source = source + 2e-5 * np.random.default_rng(1).normal(size=source.shape)
    found = register(source, target.points, target.covariances)
    roots = np.linalg.inv(np.linalg.cholesky(target.covariances))

    def whitened(change):
        moved = p.apply(found.transform, source)
        turned = (
            (moved - found.transform[:3, 3]) @ p.rotation_exp(change[3:]).T
            + found.transform[:3, 3]
            + change[:3]
        )
        return np.einsum("nij,nj->ni", roots, turned - target.points).ravel()

    best = least_squares(whitened, np.zeros(6), x_scale=1e-5, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(best.x).max() < 1e-9
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-3, atol=1e-13
    )
    np.testing.assert_allclose(
        found.misfit, (whitened(np.zeros(6)).reshape(-1, 3) ** 2).sum(axis=1), rtol=1e-9
    )


LINE, EACH = np.outer(np.arange(5.0), [0.1, 0.05, 0.0]), np.tile(np.eye(3), (5, 1, 1))
UP = np.array([0.0, 0.0, 1.0])


def test_several_sets_of_points_are_fitted_as_each_alone():
    rng, plane = np.random.default_rng(5), np.repeat(np.arange(3), 5)
    normals = np.array([[0.0, 0.0, 1.0], [0.8, 0.5, 0.3], [0.8, -0.5, 0.2]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source = rng.uniform(-0.1, 0.1, (15, 3))
    source -= np.einsum("ni,ni->n", source, normals[plane])[:, None] * normals[plane]
    moves = p.transforms_of(rng.uniform(-1.0, 1.0, (4, 6)))
    points = p.apply_each(moves, source) + 1e-5 * rng.normal(size=(4, 15, 3))
    roots = 1e-5 * (np.eye(3) + 0.3 * rng.normal(size=(4, 15, 3, 3)))
    covariances = roots @ roots.swapaxes(-1, -2)
    towards = normals @ moves[:, :3, :3].swapaxes(1, 2)
    frames, laid = (
        frames_of_points(points, covariances, plane, towards)[0],
        register_sets(source, points, covariances).transform,
    )
    for k in range(4):
        own = points[k], covariances[k]
        np.testing.assert_allclose(
            frames[k], frame_of_points(*own, plane, towards[k])[0], atol=1e-12
        )
        np.testing.assert_allclose(laid[k], register(source, *own).transform, atol=1e-12)
    np.testing.assert_allclose(frames, moves @ frame_from_planes(normals, np.zeros(3)), atol=1e-3)


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        (
            lambda: fit_plane(LINE[:2], EACH[:2], UP, "B"),
            "plane B: 2 visible stickers, but at least 3 are needed",
        ),
        (lambda: fit_plane(LINE, EACH, UP, "B"), "plane B: its 5 visible stickers lie on one line"),
        (lambda: register(LINE[:2], LINE[:2], EACH[:2]), "2 visible stickers"),
        (lambda: register(LINE, LINE, EACH), "5 visible stickers"),
    ],
)
def test_too_few_points_and_those_on_a_line_are_lost(fit, message):
    with pytest.raises(LostError, match=message):
        fit()


@pytest.mark.parametrize(
    "lens",
    [
        pytest.param((-0.12, 0.03, 1e-3, -7e-4, -4e-3), id="barrel"),
        pytest.param((0.15, 0.06, -8e-4, 5e-4, 0.02), id="cushion"),
        pytest.param((-0.2, 0.25, 3e-4, 2e-4, -0.05), id="moustache"),
    ],
)
def test_distorted_pixels_are_those_of_opencv_forth_and_back_with_the_jacobian_of_differences(lens):
    camera = PinholeCamera(
        2300.0, 1020.0, 771.0, 2048, 1536, aspect=1.004, distortion=Distortion(*lens)
    )
    matrix, coefficients, rng = camera.matrix, np.array(lens), np.random.default_rng(1)
    points = rng.uniform([-0.6, -0.45, 1.4], [0.6, 0.45, 2.2], (200, 3))
    shown, inside = camera.project(points)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(shown, expected.reshape(-1, 2), rtol=0.0, atol=1e-9)
    assert inside.mean() > 0.5
    pixels = rng.uniform(0.0, [2047.0, 1535.0], (300, 2))
    ideal, found = camera.undistort(pixels)
    assert found.all()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    # as OpenCV 4 calls it, and OpenCV 5
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    expected = undistort(
        pixels[:, None], matrix, coefficients, R=np.eye(3), P=matrix, criteria=criteria
    )
    np.testing.assert_allclose(ideal, expected.reshape(-1, 2), rtol=0.0, atol=1e-6)
    # 1e-12 focal lengths
    np.testing.assert_allclose(camera.distort(ideal)[0], pixels, rtol=0.0, atol=3e-9)
    for k, step in enumerate(1e-3 * np.eye(2)):
        slope = (camera.distort(pixels + step)[0] - camera.distort(pixels - step)[0]) / 2e-3
        np.testing.assert_allclose(camera.distortion_jacobian(pixels)[..., k], slope, atol=1e-8)


@given(
    st.floats(-0.4, 0.4),
    st.floats(-0.3, 0.3),
    st.floats(-0.1, 0.1),
    st.floats(-3e-3, 3e-3),
    st.floats(-3e-3, 3e-3),
)
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
    found, ok = lens.undistort(
        np.array([[0.99 * farthest, 0.0], [1.01 * farthest, 0.0], [40.0, -9.0]])
    )
    np.testing.assert_array_equal(ok, [True, False, False])
    assert np.isfinite(found).all()
    camera = PinholeCamera(500.0, 1000.0, 700.0, 2048, 1536, distortion=lens)
    # the second one folds back into the image
    points = np.array([[0.5, 0.0, 1.0], [1.2, 0.0, 1.0]])
    pixels, valid = camera.project(points)
    assert camera.shows(pixels).all()
    np.testing.assert_array_equal(valid, [True, False])
    assert Distortion(k1=0.1).fold_radius == np.inf
