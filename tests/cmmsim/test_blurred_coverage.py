"""Blurred coverage against brute-force integration, and the fit of blurred windows against its own promise."""

import numpy as np
import pytest
from scipy.special import ndtr

import cmmsim
from cmmsim.detection.ellipse_fit import fit_ellipses
from cmmsim.geometry.disc_image import SHAPE_BASIS, blurred_coverage
from tests.cmmsim.ellipses import NOISE, random_ellipses

SIZE = 20


def integrated(centre, shape, psf_px, rings=120, rays=240):
    """Light of each pixel by quadrature over the whole disc in polar coordinates; (SIZE, SIZE)."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    radius, angle = 0.5 * (node + 1.0)[:, None], 2.0 * np.pi * np.arange(rays) / rays
    unit = np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    area = np.linalg.det(shape) * np.pi / rays * (weight[:, None] * radius * np.ones(rays)).ravel()
    ends = np.arange(SIZE + 1)[:, None] - 0.5
    x, y = (np.diff(ndtr((ends - p) / psf_px), axis=0) for p in shape @ unit + centre[:, None])
    return (y * area) @ x.T


@pytest.mark.parametrize("psf_px", [0.3, 0.5, 1.0, 2.0])
def test_shares_match_brute_force_integration(psf_px):
    centres, shapes = random_ellipses(np.random.default_rng(0), 3, SIZE)
    shares, _ = blurred_coverage(centres, shapes, SIZE, psf_px)
    for centre, shape, share in zip(centres, shapes, shares, strict=True):
        np.testing.assert_allclose(share, integrated(centre, shape, psf_px), atol=2e-7)


@pytest.mark.parametrize("psf_px", [0.05, 0.4, 1.0])
@pytest.mark.parametrize("radii", [(1.0, 0.85), (3.8, 2.4), (7.0, 3.0)])
def test_all_light_is_kept_however_narrow_and_small(psf_px, radii):
    centres, shapes = random_ellipses(np.random.default_rng(1), 5, SIZE, radii)
    shares, _ = blurred_coverage(centres + 0.5 * SIZE, shapes, 2 * SIZE, psf_px)
    np.testing.assert_allclose(shares.sum(axis=(1, 2)), np.pi * np.prod(radii), rtol=1e-6)
    assert shares.min() > -1e-6
    assert shares.max() < 1.0 + 1e-6


@pytest.mark.parametrize("parameter", range(5))
def test_derivatives_match_finite_differences(parameter):
    centres, shapes = random_ellipses(np.random.default_rng(2), 4, SIZE)
    _, derivatives = blurred_coverage(centres, shapes, SIZE, 0.5)
    moved = []
    for sign in (1e-5, -1e-5):
        c, s = centres.copy(), shapes.copy()
        if parameter < 2:
            c[:, parameter] += sign
        else:
            s += sign * SHAPE_BASIS[parameter - 2]
        moved.append(blurred_coverage(c, s, SIZE, 0.5)[0])
    np.testing.assert_allclose(derivatives[..., parameter], (moved[0] - moved[1]) / 2e-5, atol=1e-6)


def test_fit_of_blurred_windows_reaches_its_own_covariance_and_has_no_bias():
    rng = np.random.default_rng(3)
    centres, shapes = random_ellipses(rng, 2000, SIZE)
    radiance = (8.0 + 220.0 * blurred_coverage(centres, shapes, SIZE, 0.6)[0]) / 255.0
    fits = fit_ellipses(
        NOISE.expose(radiance.astype(np.float32), rng), np.zeros((2000, 2), dtype=int), NOISE, 18, psf_px=0.6
    )
    error = fits.centres - centres
    assert fits.good.all()
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariances), error).mean() == pytest.approx(2, rel=0.07)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * error.std() / np.sqrt(2000)
    shape_error = (fits.shapes - shapes)[:, [0, 0, 1], [0, 1, 1]]
    assert np.abs(shape_error.mean(axis=0)).max() < 4.0 * shape_error.std() / np.sqrt(2000)


def test_too_narrow_a_point_spread_is_refused():
    with pytest.raises(cmmsim.CmmError, match=r"0\.01 px.*0\.05 px"):
        fit_ellipses(np.zeros((1, 16, 16)), np.zeros((1, 2), dtype=int), NOISE, 14, psf_px=0.01)
