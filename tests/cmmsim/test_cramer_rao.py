"""The Cramer-Rao bound against differentiated images, tables of probabilities and its known limit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from cmmsim.detection.cramer_rao import cramer_rao_bound, grey_value_information
from cmmsim.geometry.disc_image import SHAPE_BASIS, coverage
from cmmsim.radiometry.noise import CameraNoise
from tests.cmmsim.sensors import NOISE

WHITE = CameraNoise(electrons_at_white=1e7, gain=2e-5, dark_noise=2e5, full_well=2e7, black_level=16.0)  # 4 grey values
CONTRAST, GROUND, SIZE = 180.0, 22.0, 14
CENTRES = np.array([[6.31, 6.74], [6.5, 6.02]])
SHAPES = np.array([[[3.6, 0.5], [0.5, 2.4]], [[2.5, 0.0], [0.0, 2.5]]])


@pytest.mark.parametrize("psf_px", [0.0, 0.6])
def test_bound_is_that_of_numerically_differentiated_images(psf_px):
    """Fisher information of normal grey values with mean m and variance v(m), differentiated by all 7 unknowns."""
    step = 1e-5
    for centre, shape in zip(CENTRES, SHAPES, strict=True):

        def image(p):
            share = coverage(p[None, :2], np.tensordot(p[2:5], SHAPE_BASIS, 1)[None], SIZE, psf_px)[0]
            return (p[6] + p[5] * share).ravel()

        start = np.array([*centre, shape[0, 0], shape[0, 1], shape[1, 1], CONTRAST, GROUND])
        changes = [image(start + step * e) - image(start - step * e) for e in np.eye(7)]
        jacobian = np.stack(changes, axis=1) / (2.0 * step)
        variance = NOISE.variance(image(start))
        information = 1.0 / variance + 0.5 * (NOISE.gain / variance) ** 2  # the variance grows by K a grey value
        expected = np.linalg.inv(jacobian.T @ (information[:, None] * jacobian))[:2, :2]
        bound = cramer_rao_bound(centre[None], shape[None], SIZE, CONTRAST, GROUND, NOISE, psf_px)[0]
        np.testing.assert_allclose(bound, expected, rtol=1e-4, atol=1e-4 * expected.trace())


def test_information_of_a_rounded_number_is_that_of_its_probabilities():
    """Probabilities of all 256 grey values, differentiated numerically; with little noise rounding decides."""
    for noise in (NOISE, replace(NOISE, electrons_at_white=5e4, gain=0.13 / 31, dark_noise=100.0, full_well=6e4)):
        for mean in (22.0, 22.37, 22.5, 120.2, 254.9):

            def probabilities(mean, noise=noise):
                edges = np.concatenate([[-np.inf], np.arange(255) + 0.5, [np.inf]])
                return np.diff(norm.cdf(edges, mean, np.sqrt(noise.variance(mean) - 1.0 / 12.0)))

            slope = (probabilities(mean + 1e-4) - probabilities(mean - 1e-4)) / 2e-4
            likely = probabilities(mean) > 1e-10
            expected = np.sum(slope[likely] ** 2 / probabilities(mean)[likely])
            assert grey_value_information(np.array([mean]), noise)[0] == pytest.approx(expected, rel=1e-4)


def edge_bound(shapes, contrast, deviation, psf_px):
    """Closed-form approximation (n,2,2) px² of the bound: a smooth edge in white noise, nothing but the centre unknown.

    An edge of width s = sqrt(psf² + 1/12) carries contrast² / (2 sqrt(pi) s deviation²) of information a px of its
    length about a shift across it. For a circle: sigma_x = deviation / contrast * sqrt(2 s / (sqrt(pi) r)).
    """
    width = np.sqrt(psf_px**2 + 1.0 / 12.0)
    angles = 2.0 * np.pi * np.arange(256) / 256
    around = np.stack([np.cos(angles), np.sin(angles)])
    across = np.linalg.inv(shapes) @ around  # normals of the rim at A (cos, sin), not of length one
    along = np.linalg.norm(shapes @ np.stack([-np.sin(angles), np.cos(angles)]), axis=1) * (2.0 * np.pi / 256)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    spread = np.einsum("nik,njk,nk->nij", across, across, along)
    return np.linalg.inv(spread) * (2.0 * np.sqrt(np.pi) * width * (deviation / contrast) ** 2)


@pytest.mark.parametrize("half_axes", [(20.0, 20.0), (24.0, 12.0)])
def test_large_blurred_disc_reaches_the_closed_form_of_an_edge(half_axes):
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    centre, shape = np.array([[29.7, 30.2]]), (turn @ np.diag(half_axes) @ turn.T)[None]
    deviation = float(np.sqrt(WHITE.variance(np.array(GROUND + 0.5 * CONTRAST))))
    exact = cramer_rao_bound(centre, shape, 60, CONTRAST, GROUND, WHITE, 1.0)[0]
    closed = edge_bound(shape, CONTRAST, deviation, 1.0)[0]
    np.testing.assert_allclose(closed, exact, rtol=0.02, atol=0.02 * exact[0, 0])


@pytest.mark.slow
def test_twelve_bits_with_the_same_noise_keep_the_bound():
    """Sixteen times the gain: all grey values are sixteen times larger, and rounding matters less."""
    fine = replace(NOISE, bit_depth=12, gain=16.0 * NOISE.gain, black_level=256.0)
    coarse, deep = (
        cramer_rao_bound(CENTRES, SHAPES, SIZE, k * CONTRAST, k * GROUND, noise, 0.0)
        for k, noise in ((1.0, NOISE), (16.0, fine))
    )
    np.testing.assert_allclose(deep, coarse, rtol=0.02, atol=1e-8)
    assert np.all(np.trace(deep, axis1=1, axis2=2) < np.trace(coarse, axis1=1, axis2=2))
