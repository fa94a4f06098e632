"""The fit of ellipses against its own normal equations and its statistical promise."""

import numpy as np
import pytest

import cmmsim
from cmmsim.detection import ellipse_fit, fit_kernels
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import RING_REACH, fit_ellipses
from cmmsim.geometry.disc_image import coverage
from tests.cmmsim.ellipses import NOISE, random_ellipses

SIZE, FIT = 16, 14


def exposed(seed, count, radii=(3.8, 2.4), size=SIZE, psf_px=0.0):
    """True centres and shapes, noisy windows, and where they are cut out."""
    rng = np.random.default_rng(seed)
    centres, shapes = random_ellipses(rng, count, size, radii)
    radiance = (8.0 + 220.0 * coverage(centres, shapes, size, psf_px)[0]) / 255.0
    return centres, shapes, NOISE.expose(radiance.astype(np.float32), rng), np.tile([1000, 700], (count, 1))


def steps_left(fits, windows):
    """Gauss-Newton steps (n, 7) that plain numpy would still take, covariances (n,5,5) and misfits (n,) there, for
    windows that lie wholly within the ring."""
    share, derivatives = coverage(fits.centres, fits.shapes, windows.shape[-1])
    contrast, ground = fits.contrast[:, None, None], fits.ground[:, None, None]
    mean = ground + contrast * share
    weights, residuals = 1.0 / NOISE.variance(mean), windows - mean
    jacobian = np.concatenate([contrast[..., None] * derivatives, share[..., None], np.ones_like(mean)[..., None]], -1)
    normal = np.einsum("nyxi,nyx,nyxj->nij", jacobian, weights, jacobian)
    right = np.einsum("nyxi,nyx,nyx->ni", jacobian, weights, residuals)
    freedom = windows[0].size - 7
    misfit = (weights * residuals**2).sum(axis=(1, 2)) / freedom
    return np.linalg.solve(normal, right[..., None])[..., 0], np.linalg.inv(normal)[:, :5, :5], misfit


def test_the_fit_ends_where_plain_numpy_would_stay(monkeypatch):
    """After many iterations nothing is left of a step; covariances and misfits are those of the normal equations."""
    monkeypatch.setattr(ellipse_fit, "CONVERGED_PX", 0.0)
    _, _, windows, corners = exposed(2, 300, (5.0, 4.9), FIT)
    fits = fit_ellipses(windows, np.zeros_like(corners), NOISE, FIT, FitLimits(largest_misfit=np.inf), iterations=60)
    assert np.hypot(FIT / 2 + 1, FIT / 2 + 1) < RING_REACH * 4.9  # the ring holds all pixels
    steps, covariances, misfits = steps_left(fits, windows.astype(float))
    deviation = np.sqrt(np.einsum("nii->ni", covariances))
    assert np.quantile(np.abs(steps[:, :5]) / deviation, 0.99) < 1e-3
    np.testing.assert_allclose(fits.covariances, covariances[:, :2, :2], rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(fits.shape_covariances, covariances[:, 2:, 2:], rtol=2e-3, atol=1e-8)
    np.testing.assert_allclose(fits.misfits, misfits, rtol=1e-6)


def test_the_fit_stops_no_earlier_than_the_noise_allows():
    """Against sixty steps: nearly all within a hundredth of a standard deviation; some one in a thousand windows creep,
    because the share of a pixel has kinks in its second derivatives."""
    _, _, windows, corners = exposed(3, 1000)
    ours, theirs = (fit_ellipses(windows, corners, NOISE, FIT, iterations=count) for count in (8, 60))
    gap, deviation = np.abs(ours.centres - theirs.centres).max(axis=1), np.sqrt(theirs.covariances[:, 0, 0])
    assert np.quantile(gap / deviation, 0.99) < 0.01
    assert np.max(gap / deviation) < 0.3
    np.testing.assert_allclose(ours.covariances[:, 0, 0], theirs.covariances[:, 0, 0], rtol=5e-3)


@pytest.mark.parametrize(("psf_px", "size", "rel", "seed"), [(0.0, 18, 0.06, 3), (0.6, 20, 0.07, 3)])
def test_fit_reaches_its_own_covariance_and_has_no_bias(psf_px, size, rel, seed):
    centres, shapes, windows, corners = exposed(seed, 3000, size=size, psf_px=psf_px)
    fits = fit_ellipses(windows, corners, NOISE, size - 2, psf_px=psf_px)
    error = fits.centres - corners - centres
    assert fits.good.all()
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariances), error)
    assert squared.mean() == pytest.approx(2.0, rel=rel)
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


def test_half_hidden_sticker_and_empty_window_are_not_good():
    _, _, windows, corners = exposed(4, 2)
    dark = np.rint(NOISE.mean_grey(np.array(8.0 / 255.0))).astype(np.uint8)
    windows[0, :, 8:] = dark
    windows[1] = dark
    assert not fit_ellipses(windows, corners, NOISE, FIT).good.any()


def test_windows_fitted_together_are_those_fitted_alone():
    """A second thread takes half of many windows; which one fits a window changes nothing."""
    _, _, windows, corners = exposed(5, 37)
    together = fit_ellipses(windows, corners, NOISE, FIT)
    for k in range(37):
        alone = fit_ellipses(windows[k : k + 1], corners[k : k + 1], NOISE, FIT)
        np.testing.assert_array_equal(together.centres[k], alone.centres[0])
        np.testing.assert_array_equal(together.covariances[k], alone.covariances[0])
        assert together.misfits[k] == alone.misfits[0]


def test_windows_without_an_ellipse_give_finite_numbers():
    flat = np.zeros((3, SIZE, SIZE))
    flat[1], flat[2, 3, 3] = 255.0, 255.0
    fits = fit_ellipses(flat, np.zeros((3, 2), dtype=int), NOISE, FIT)
    assert not fits.good.any()
    for name in ("centres", "covariances", "shapes", "shape_covariances", "contrast", "misfits"):
        assert np.isfinite(getattr(fits, name)).all()


def test_selection_and_bounded_radii():
    rng = np.random.default_rng(7)
    for count in (1, 2, 7, 256):
        values = rng.integers(0, 30, count).astype(float)
        for n in {0, count // 3, count - 1}:
            assert fit_kernels.nth_smallest(values.copy(), n) == np.sort(values)[n]
    matrix = np.array([[4.0, 1.5], [1.5, 0.9]])
    xx, xy, yy = fit_kernels.bound_radii(4.0, 1.5, 0.9, 0.5, 3.0)
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose([[xx, xy], [xy, yy]], vectors @ np.diag(np.clip(values, 0.5, 3.0)) @ vectors.T)


def test_too_narrow_a_point_spread_is_refused():
    with pytest.raises(cmmsim.CmmError, match=r"0\.01 px.*0\.05 px"):
        fit_ellipses(np.zeros((1, 16, 16)), np.zeros((1, 2), dtype=int), NOISE, 14, psf_px=0.01)
