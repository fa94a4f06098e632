"""The fit of ellipses against plain numpy and its statistical promise."""

import numpy as np
import pytest

from cmmsim.detection import ellipse_fit, fit_kernels
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import RING_REACH, fit_ellipses
from cmmsim.detection.fit_kernels import CORE_SHARE, SMALLEST_START_PX
from cmmsim.geometry.disc_image import coverage
from tests.cmmsim import plain_coverage
from tests.cmmsim.sensors import NOISE, random_ellipses, require_true, squares

SIZE, FIT = 16, 14
LARGEST_STEP = np.array([1.0, 1.0, 0.8, 0.8, 0.8, 100.0, 40.0])


def exposed(seed, count, radii=(3.8, 2.4), size=SIZE, psf_px=0.0):
    """True centres and shapes, noisy windows, and where they are cut out."""
    rng = np.random.default_rng(seed)
    centres, shapes = random_ellipses(rng, count, size, radii)
    radiance = (8.0 + 220.0 * coverage(centres, shapes, size, psf_px)[0]) / 255.0
    return centres, shapes, NOISE.expose(radiance.astype(np.float32), rng), np.tile([1000, 700], (count, 1))


def moments(window):
    """Ground, contrast, centroid (2,) and spread (2,2) of the bright spot of a window."""
    grey = np.sort(window.ravel())
    ground = grey[len(grey) // 3]
    contrast = max(grey[-6] - ground, 1.0)
    share = ((window - ground) / contrast).ravel()
    share = np.where(share > CORE_SHARE, np.minimum(share, 1.0), 0.0)
    places = np.indices(window.shape)[::-1].reshape(2, -1)
    return ground, contrast, np.average(places, axis=1, weights=share), np.cov(places, aweights=share, ddof=0)


def plain_fit(window, iterations):
    """Parameters (7,), their covariance (7,7) and the misfit of one window after so many steps, in plain numpy."""
    first = np.clip(np.rint(moments(window)[2] - 0.5 * (FIT - 1)).astype(int), 0, SIZE - FIT)
    part = window[first[1] : first[1] + FIT, first[0] : first[0] + FIT]
    ground, contrast, middle, spread = moments(part)
    radii, axes = np.linalg.eigh(spread)  # a uniform ellipse has spread A A / 4
    shape = axes * np.clip(2.0 * np.sqrt(radii), SMALLEST_START_PX, 0.5 * FIT) @ axes.T
    p = np.array([*middle, shape[0, 0], shape[0, 1], shape[1, 1], contrast, ground])
    away = np.indices(part.shape)[::-1].reshape(2, -1) - middle[:, None]
    in_ring = np.linalg.norm(np.linalg.solve(shape, away), axis=0) < RING_REACH
    for step in range(iterations + 1):
        share, slopes = plain_coverage.coverage(p[None, :2], p[[2, 3, 3, 4]].reshape(1, 2, 2), FIT)
        jacobian = np.column_stack([p[5] * slopes.reshape(-1, 5), share.ravel(), np.ones(share.size)])
        residuals = part.ravel() - p[6] - p[5] * share.ravel()
        weights = in_ring / NOISE.variance(part.ravel() - residuals)
        normal = jacobian.T * weights @ jacobian + 1e-9 * np.eye(7)
        if step < iterations:
            p += np.clip(np.linalg.solve(normal, jacobian.T @ (weights * residuals)), -LARGEST_STEP, LARGEST_STEP)
    p[:2] += first
    return p, np.linalg.inv(normal), (weights * residuals**2).sum() / (in_ring.sum() - 7)


@pytest.mark.parametrize("radii", [(3.8, 2.4), (2.2, 1.8), (5.0, 4.9)])
def test_the_fit_takes_the_steps_of_plain_numpy(monkeypatch, radii):
    """From the same start, over the same pixels; covariances and misfits are those of the normal equations."""
    monkeypatch.setattr(ellipse_fit, "CONVERGED_PX", 0.0)
    _, _, windows, corners = exposed(2, 300, radii)
    fits = fit_ellipses(windows, corners, NOISE, FIT, FitLimits(largest_misfit=np.inf), iterations=3)
    p, covariances, misfits = map(np.array, zip(*(plain_fit(w.astype(float), 3) for w in windows), strict=True))
    close = {"atol": 1e-9, "rtol": 1e-9}
    np.testing.assert_allclose(fits.centres, p[:, :2] + corners, **close)
    np.testing.assert_allclose(fits.shapes, p[:, [2, 3, 3, 4]].reshape(-1, 2, 2), **close)
    np.testing.assert_allclose(np.stack([fits.contrast, fits.ground, fits.misfits]), [*p[:, 5:].T, misfits], **close)
    np.testing.assert_allclose(fits.covariances, covariances[:, :2, :2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fits.shape_covariances, covariances[:, 2:5, 2:5], rtol=1e-9, atol=1e-12)


def test_the_fit_stops_no_earlier_than_the_noise_allows():
    """Against sixty steps: nearly all within a hundredth of a standard deviation; some one in a thousand windows creep,
    because the share of a pixel has kinks in its second derivatives."""
    _, _, windows, corners = exposed(3, 1000)
    ours, theirs = (fit_ellipses(windows, corners, NOISE, FIT, iterations=count) for count in (8, 60))
    gap, deviation = np.abs(ours.centres - theirs.centres).max(axis=1), np.sqrt(theirs.covariances[:, 0, 0])
    assert np.quantile(gap / deviation, 0.99) < 0.01
    assert np.max(gap / deviation) < 0.3
    np.testing.assert_allclose(ours.covariances[:, 0, 0], theirs.covariances[:, 0, 0], rtol=5e-3)


@pytest.mark.parametrize(("psf_px", "size"), [(0.0, 18), (0.6, 20)])
def test_fit_reaches_its_own_covariance_and_has_no_bias(psf_px, size):
    centres, shapes, windows, corners = exposed(3, 3000, size=size, psf_px=psf_px)
    fits = fit_ellipses(windows, corners, NOISE, size - 2, psf_px=psf_px)
    error = fits.centres - corners - centres
    assert fits.good.all()
    require_true(squares(error, fits.covariances), 2)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * error.std() / np.sqrt(3000)
    assert 0.005 < error.std() < 0.015  # px, "about 0.01 px"
    shape_error = (fits.shapes - shapes)[:, [0, 0, 1], [0, 1, 1]]
    assert np.abs(shape_error.mean(axis=0)).max() < 4.0 * shape_error.std() / np.sqrt(3000)


def test_fit_of_noise_free_windows_is_exact():
    centres, shapes = random_ellipses(np.random.default_rng(2), 40, 18)
    radiance = ((8.0 + 220.0 * coverage(centres, shapes, 18)[0]) / 255.0).astype(np.float32)
    fits = fit_ellipses(NOISE.mean_grey(radiance), np.zeros((40, 2), dtype=int), NOISE, 16)
    assert fits.good.all()
    assert np.abs(fits.centres - centres).max() < 1e-5  # float32 radiance


def test_windows_fitted_together_are_those_fitted_alone():
    """A second thread takes half of many windows; which one fits a window changes nothing."""
    _, _, windows, corners = exposed(5, 37)
    together = fit_ellipses(windows, corners, NOISE, FIT)
    for k in range(37):
        alone = fit_ellipses(windows[k : k + 1], corners[k : k + 1], NOISE, FIT)
        np.testing.assert_array_equal(together.centres[k], alone.centres[0])
        np.testing.assert_array_equal(together.covariances[k], alone.covariances[0])
        assert together.misfits[k] == alone.misfits[0]


def test_windows_without_a_whole_ellipse_are_not_good_and_give_finite_numbers():
    _, _, windows, corners = exposed(4, 4)
    windows[:, :, 8:] = windows.min()  # the last one stays half hidden
    windows[:3], windows[1], windows[2, 3, 3] = 0, 255, 255
    fits = fit_ellipses(windows, corners, NOISE, FIT)
    assert not fits.good.any()
    for name in ("centres", "covariances", "shapes", "shape_covariances", "contrast", "misfits"):
        assert np.isfinite(getattr(fits, name)).all()


def test_radii_are_kept_between_their_bounds():
    matrix = np.array([[4.0, 1.5], [1.5, 0.9]])
    xx, xy, yy = fit_kernels.bound_radii(4.0, 1.5, 0.9, 0.5, 3.0)
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose([[xx, xy], [xy, yy]], vectors @ np.diag(np.clip(values, 0.5, 3.0)) @ vectors.T)
