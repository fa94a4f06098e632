"""Triangulation and rigid fit against a general least-squares solver."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import cmmsim
from cmmsim.geometry import point_kernels as point_kernel
from cmmsim.geometry.pose import apply, rotation_exp
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import triangulate


@pytest.fixture(scope="module")
def seen():
    """A rig, and noisy pixels (2, n, 2) of points with their covariances (2, n, 2, 2)."""
    rig, rng = cmmsim.load_sensor("ctrack780").rig, np.random.default_rng(0)
    points = rng.uniform([0.3, -0.2, 1.3], [0.7, 0.2, 1.7], (12, 3))
    half = rng.normal(size=(2, 12, 2, 2))
    covariances = 1e-4 * (half @ half.transpose(0, 1, 3, 2) + np.eye(2))
    return rig, rig.project(points)[0] + 0.02 * rng.normal(size=(2, 12, 2)), covariances


def test_points_explain_their_pixels_best(seen):
    rig, pixels, covariances = seen
    found = triangulate(rig, *pixels, *covariances)
    roots = np.linalg.inv(np.linalg.cholesky(covariances))
    for n in range(pixels.shape[1]):

        def whitened(point, n=n):
            return np.einsum("kij,kj->ki", roots[:, n], rig.project(point[None])[0][:, 0] - pixels[:, n]).ravel()

        best = least_squares(whitened, found.points[n] + 1e-4, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.points[n], best.x, atol=2e-9)
        np.testing.assert_allclose(found.covariances[n], np.linalg.inv(best.jac.T @ best.jac), rtol=1e-4, atol=1e-13)
        assert found.ray_gap[n] == pytest.approx(2.0 * best.cost, rel=1e-4)


def test_transform_explains_the_points_best(seen):
    rig, pixels, covariances = seen
    target = triangulate(rig, *pixels, *covariances)
    source = target.points @ rotation_exp(np.array([0.4, -0.8, 0.3])) + [0.1, 0.2, -0.3]
    source = source + 2e-5 * np.random.default_rng(1).normal(size=source.shape)
    found = register(source, target.points, target.covariances)
    roots = np.linalg.inv(np.linalg.cholesky(target.covariances))

    def whitened(change):
        moved = apply(found.transform, source)
        turned = (moved - found.transform[:3, 3]) @ rotation_exp(change[3:]).T + found.transform[:3, 3] + change[:3]
        return np.einsum("nij,nj->ni", roots, turned - target.points).ravel()

    best = least_squares(whitened, np.zeros(6), x_scale=1e-5, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.abs(best.x).max() < 1e-9
    np.testing.assert_allclose(found.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-3, atol=1e-13)
    np.testing.assert_allclose(found.misfit, (whitened(np.zeros(6)).reshape(-1, 3) ** 2).sum(axis=1), rtol=1e-9)


def test_kernels_compute_the_same_uncompiled(seen):
    rig, pixels, covariances = seen
    observed, weights = pixels.transpose(1, 0, 2).copy(), np.linalg.inv(covariances.transpose(1, 0, 2, 3))
    start = triangulate(rig, *pixels, *covariances).points + 1e-4
    results = []
    for function in (point_kernel.refine_points, point_kernel.refine_points.py_func):
        points, spread, gaps = start.copy(), np.empty((12, 3, 3)), np.empty(12)
        function(np.stack(rig.projection_matrices), observed, weights, 2, points, spread, gaps)
        results.append(np.concatenate([points.ravel(), spread.ravel(), gaps]))
    np.testing.assert_allclose(*results, rtol=1e-9)
