"""Coverage of pixels against brute-force sampling, and the fit against its own statistical promise."""

import numpy as np
import pytest

from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.disc_image import SHAPE_BASIS, coverage
from tests.cmmsim.ellipses import NOISE, random_ellipses

SIZE = 18


def test_coverage_matches_sampling_each_pixel():
    centres, shapes = random_ellipses(np.random.default_rng(0), 3, SIZE)
    area, _ = coverage(centres, shapes, SIZE)
    fine = 50
    ticks = (np.arange(SIZE * fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(ticks, ticks)
    for centre, shape, exact in zip(centres, shapes, area, strict=True):
        unit = np.linalg.solve(shape, np.stack([x - centre[0], y - centre[1]]).reshape(2, -1))
        sampled = ((unit**2).sum(axis=0) < 1.0).reshape(SIZE, fine, SIZE, fine).mean(axis=(1, 3))
        assert np.abs(sampled - exact).max() < 0.01
        assert exact.sum() == pytest.approx(np.pi * np.linalg.det(shape), rel=1e-12)


@pytest.mark.parametrize("parameter", range(5))
def test_coverage_derivatives_match_finite_differences(parameter):
    centres, shapes = random_ellipses(np.random.default_rng(1), 4, SIZE)
    _, derivatives = coverage(centres, shapes, SIZE)
    moved = []
    for sign in (1e-6, -1e-6):
        c, s = centres.copy(), shapes.copy()
        if parameter < 2:
            c[:, parameter] += sign
        else:
            s += sign * SHAPE_BASIS[parameter - 2]
        moved.append(coverage(c, s, SIZE)[0])
    np.testing.assert_allclose(derivatives[..., parameter], (moved[0] - moved[1]) / 2e-6, atol=1e-7)


def draw(rng, count):
    centres, shapes = random_ellipses(rng, count, SIZE)
    radiance = (8.0 + 220.0 * coverage(centres, shapes, SIZE)[0]) / 255.0
    return centres, radiance.astype(np.float32)


def test_fit_of_noise_free_windows_is_exact():
    centres, radiance = draw(np.random.default_rng(2), 40)
    fits = fit_ellipses(NOISE.mean_grey(radiance), np.zeros((40, 2), dtype=int), NOISE, 16)
    assert fits.good.all()
    assert np.abs(fits.centres - centres).max() < 1e-5  # float32 radiance


def test_fit_reaches_its_own_covariance_and_has_no_bias():
    rng = np.random.default_rng(3)
    centres, radiance = draw(rng, 3000)
    fits = fit_ellipses(NOISE.expose(radiance, rng), np.zeros((3000, 2), dtype=int), NOISE, 16)
    error = fits.centres - centres
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariances), error)
    assert fits.good.all()
    assert squared.mean() == pytest.approx(2.0, rel=0.06)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * error.std() / np.sqrt(3000)
    assert 0.005 < error.std() < 0.012  # px, "about 0.01 px"


def test_half_hidden_sticker_and_empty_window_are_not_good():
    rng = np.random.default_rng(4)
    _, radiance = draw(rng, 2)
    radiance[0, :, 9:] = 8.0 / 255.0
    radiance[1] = 8.0 / 255.0
    assert not fit_ellipses(NOISE.expose(radiance, rng), np.zeros((2, 2), dtype=int), NOISE, 16).good.any()


def test_noise_has_the_stated_variance():
    """Photon transfer: variance against mean has the slope K and the dark noise as its start."""
    rng = np.random.default_rng(5)
    for level in (0.05, 0.3, 0.8):
        grey = NOISE.expose(np.full((400, 400), level, dtype=np.float32), rng).astype(float)
        expected = 0.13**2 * (1600.0 * level + 26.0**2) + 1.0 / 12.0
        assert grey.var() == pytest.approx(expected, rel=0.02)
        assert grey.mean() == pytest.approx(16.0 + 0.13 * 1600.0 * level, abs=0.05)
