"""Poses, cameras, triangulation, plane frames and registration against closed forms and scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cmmsim.errors import LostError
from cmmsim.geometry import point_kernels
from cmmsim.geometry import pose as p
from cmmsim.geometry.plane_frame import fit_plane, frame_from_planes, frame_of_points
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import toed_in_rig, triangulate
from tests.cmmsim.sensors import CAMERA

ANGLE = st.floats(-1.4, 1.4)
RIG, CAMERA_FROM_BASE = toed_in_rig(CAMERA, 1.0, np.array([1.44, 0.0, 1.28]), np.array([0.3, 0.0, 0.18]))


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
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    rotation = p.rotation_exp(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(p.rotation_log(rotation), vector, atol=1e-8)


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


def test_noise_free_triangulation_returns_the_points():
    points = np.random.default_rng(1).uniform([0.0, -0.2, 0.1], [0.6, 0.2, 0.4], (50, 3))
    in_camera = p.apply(CAMERA_FROM_BASE, points)
    pixels, valid = RIG.project(in_camera)
    assert valid.all()
    spread = np.broadcast_to(1e-4 * np.eye(2), (50, 2, 2))
    found = triangulate(RIG, *pixels, spread, spread)
    assert np.abs(found.points - in_camera).max() < 1e-11
    assert found.ray_gap.max() < 1e-12


def test_plane_frame_of_exact_points():
    """Three planes built from a known frame give it back, seen from anywhere."""
    rng = np.random.default_rng(2)
    normals = np.array([[0.0, 0.0, 1.0], [0.8, 0.5, 0.3], [0.8, -0.5, 0.2]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = np.array([0.19, 0.02, 0.13])
    offsets = normals @ corner
    own = frame_from_planes(normals, offsets)
    np.testing.assert_allclose(own[:3, 3], corner, atol=1e-14)
    np.testing.assert_allclose(own[:3, 2], normals[0], atol=1e-14)
    np.testing.assert_allclose(normals[:2] @ own[:3, 0], 0.0, atol=1e-14)
    points, index = [], np.repeat(np.arange(3), 5)
    for normal in normals:
        spread = rng.uniform(-0.1, 0.1, (5, 3))
        points.append(corner + spread - np.outer(spread @ normal, normal))
    camera_from_body = np.eye(4)
    camera_from_body[:3, :3] = Rotation.from_rotvec([1.8, -0.9, 0.4]).as_matrix()
    camera_from_body[:3, 3] = [0.1, -0.2, 1.7]
    covariances = np.broadcast_to(1e-10 * np.eye(3), (15, 3, 3))
    frame, _ = frame_of_points(
        p.apply(camera_from_body, np.concatenate(points)), covariances, index, normals @ camera_from_body[:3, :3].T
    )
    np.testing.assert_allclose(frame, camera_from_body @ own, atol=1e-12)


@settings(max_examples=50)
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
            return np.einsum("kij,kj->ki", roots[:, n], RIG.project(point[None])[0][:, 0] - pixels[:, n]).ravel()

        best = least_squares(whitened, found.points[n] + 1e-4, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.points[n], best.x, atol=2e-9)
        np.testing.assert_allclose(found.covariances[n], np.linalg.inv(best.jac.T @ best.jac), rtol=1e-4, atol=1e-13)
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
        turned = (moved - found.transform[:3, 3]) @ p.rotation_exp(change[3:]).T + found.transform[:3, 3] + change[:3]
        return np.einsum("nij,nj->ni", roots, turned - target.points).ravel()

    best = least_squares(whitened, np.zeros(6), x_scale=1e-5, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(best.x).max() < 1e-9
    np.testing.assert_allclose(found.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-3, atol=1e-13)
    np.testing.assert_allclose(found.misfit, (whitened(np.zeros(6)).reshape(-1, 3) ** 2).sum(axis=1), rtol=1e-9)


def test_small_linear_algebra_is_that_of_lapack():
    rng = np.random.default_rng(6)
    half, right = rng.normal(size=(9, 7)), rng.normal(size=7)
    matrix, inverse = half.T @ half, np.empty((2, 2))
    lower, found = matrix.copy(), right.copy()
    point_kernels.factor(lower)
    point_kernels.solve_factored(lower, found)
    point_kernels.invert_factored(lower, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix)[:2, :2], rtol=1e-9)
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(matrix), rtol=1e-9)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9)


LINE, EACH = np.outer(np.arange(5.0), [0.1, 0.05, 0.0]), np.tile(np.eye(3), (5, 1, 1))
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        (lambda: fit_plane(LINE[:2], EACH[:2], UP, "B"), "plane B: 2 visible stickers, at least 3 needed"),
        (lambda: fit_plane(LINE, EACH, UP, "B"), "plane B: its 5 visible stickers lie on one line"),
        (lambda: register(LINE[:2], LINE[:2], EACH[:2]), "2 visible stickers"),
        (lambda: register(LINE, LINE, EACH), "5 visible stickers"),
    ],
)
def test_too_few_points_and_those_on_a_line_are_lost(fit, message):
    with pytest.raises(LostError, match=message):
        fit()
