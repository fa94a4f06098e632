"""The fit of ellipses against plain numpy, and the Cramer-Rao bound against differentiated images
and probabilities.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from cmmsim.detection import ellipse_fit
from cmmsim.detection.cramer_rao import cramer_rao_bound, grey_value_information
from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import RING_REACH, fit_ellipses
from cmmsim.detection.start_kernels import (
    CORE_THRESHOLD,
    SMALLEST_START_PX,
    bound_radii,
    two_of_rank,
)
from cmmsim.geometry.disc_image import SHAPE_BASIS, coverage
from tests.cmmsim.sensors import NOISE, random_ellipses, require_true, squares

SIZE, FIT = 16, 14
LARGEST_STEP = np.array([1.0, 1.0, 0.8, 0.8, 0.8, 100.0, 40.0])
# the same noise in finer grey values
FINE = replace(NOISE, bit_depth=12, gain=16.0 * NOISE.gain, black_level=256.0)


def exposed(seed, count, radii=(3.8, 2.4)):
    """Noisy windows of ellipses, and where they are cut out."""
    rng = np.random.default_rng(seed)
    radiance = (8.0 + 220.0 * coverage(*random_ellipses(rng, count, SIZE, radii), SIZE)[0]) / 255.0
    return NOISE.expose(radiance.astype(np.float32), rng), np.tile([1000, 700], (count, 1))


def moments(window):
    """Ground, contrast, centroid (2,) and spread (2,2) of the bright spot of a window."""
    grey = np.sort(window.ravel())
    ground = grey[len(grey) // 3]
    contrast = max(grey[-6] - ground, 1.0)
    share = ((window - ground) / contrast).ravel()
    share = np.where(share > CORE_THRESHOLD, np.minimum(share, 1.0), 0.0)
    places = np.indices(window.shape)[::-1].reshape(2, -1)
    return (
        ground,
        contrast,
        np.average(places, axis=1, weights=share),
        np.cov(places, aweights=share, ddof=0),
    )


def plain_fit(window, iterations):
    """Parameters (7,), their covariance (7,7) and the misfit of one window after so many steps, in
    plain numpy.
    """
    first = np.clip(np.rint(moments(window)[2] - 0.5 * (FIT - 1)).astype(int), 0, SIZE - FIT)
    part = window[first[1] : first[1] + FIT, first[0] : first[0] + FIT]
    ground, contrast, middle, spread = moments(part)
    radii, axes = np.linalg.eigh(spread)  # a uniform ellipse has spread A A / 4
    shape = axes * np.clip(2.0 * np.sqrt(radii), SMALLEST_START_PX, 0.5 * FIT) @ axes.T
    p = np.array([*middle, shape[0, 0], shape[0, 1], shape[1, 1], contrast, ground])
    away = np.indices(part.shape)[::-1].reshape(2, -1) - middle[:, None]
    in_ring = np.linalg.norm(np.linalg.solve(shape, away), axis=0) < RING_REACH
    for step in range(iterations + 1):
        share, slopes = coverage(p[None, :2], p[[2, 3, 3, 4]].reshape(1, 2, 2), FIT)
        jacobian = np.column_stack(
            [p[5] * slopes.reshape(-1, 5), share.ravel(), np.ones(share.size)]
        )
        residuals = part.ravel() - p[6] - p[5] * share.ravel()
        weights = in_ring / NOISE.variance(part.ravel() - residuals)
        normal = jacobian.T * weights @ jacobian + 1e-9 * np.eye(7)
        if step < iterations:
            p += np.clip(
                np.linalg.solve(normal, jacobian.T @ (weights * residuals)),
                -LARGEST_STEP,
                LARGEST_STEP,
            )
    p[:2] += first
    return p, np.linalg.inv(normal), (weights * residuals**2).sum() / (in_ring.sum() - 7)


@pytest.mark.parametrize("radii", [(3.8, 2.4), (2.2, 1.8), (5.0, 4.9)])
def test_the_fit_takes_the_steps_of_plain_numpy(monkeypatch, radii):
    """From the same start, over the same pixels; covariances and misfits are those of the normal
    equations.
    """
    monkeypatch.setattr(ellipse_fit, "CONVERGED_PX", 0.0)
    windows, corners = exposed(2, 300, radii)
    fits = fit_ellipses(
        windows, corners, NOISE, FIT, FitLimits(largest_misfit=np.inf), iterations=3
    )
    p, covariances, misfits = map(
        np.array, zip(*(plain_fit(w.astype(float), 3) for w in windows), strict=True)
    )
    close = {"atol": 1e-9, "rtol": 1e-9}
    np.testing.assert_allclose(fits.centres, p[:, :2] + corners, **close)
    np.testing.assert_allclose(fits.shapes, p[:, [2, 3, 3, 4]].reshape(-1, 2, 2), **close)
    np.testing.assert_allclose(
        np.stack([fits.contrast, fits.ground, fits.misfits]), [*p[:, 5:].T, misfits], **close
    )
    np.testing.assert_allclose(fits.covariances, covariances[:, :2, :2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        fits.shape_covariances, covariances[:, 2:5, 2:5], rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize(
    "values", [np.arange(3.0), np.array([7.0]), 4096.0 * np.random.default_rng(0).random(300)]
)
def test_ranks_are_those_of_sorted_values(values):
    """Few and many different ones, of any size, that fall into one step or many."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        window = rng.choice(values, (12, 12)) + rng.choice([0.0, 1e6]) * (
            rng.random((12, 12)) < 0.1
        )
        low, high = np.sort(window.ravel())[[48, 138]]
        assert two_of_rank(window, 48, 138) == (low, high)


def test_the_fit_stops_no_earlier_than_the_noise_allows():
    """Against sixty steps: nearly all within a hundredth of a standard deviation; some one in a
    thousand windows creep, because the share of a pixel has kinks in its second derivatives."""
    windows, corners = exposed(3, 1000)
    ours, theirs = (
        fit_ellipses(windows, corners, NOISE, FIT, iterations=count) for count in (8, 60)
    )
    gap, deviation = (
        np.abs(ours.centres - theirs.centres).max(axis=1),
        np.sqrt(theirs.covariances[:, 0, 0]),
    )
    assert np.quantile(gap / deviation, 0.99) < 0.01
    assert np.max(gap / deviation) < 0.3
    np.testing.assert_allclose(ours.covariances[:, 0, 0], theirs.covariances[:, 0, 0], rtol=5e-3)


def test_windows_fitted_together_are_those_fitted_alone():
    """A second thread takes half of many windows; which one fits a window changes nothing."""
    windows, corners = exposed(5, 37)
    together = fit_ellipses(windows, corners, NOISE, FIT)
    for k in range(37):
        alone = fit_ellipses(windows[k : k + 1], corners[k : k + 1], NOISE, FIT)
        np.testing.assert_array_equal(together.centres[k], alone.centres[0])
        np.testing.assert_array_equal(together.covariances[k], alone.covariances[0])
        assert together.misfits[k] == alone.misfits[0]


def test_windows_without_a_whole_ellipse_are_not_good_and_give_finite_numbers():
    windows, corners = exposed(4, 4)
    windows[:, :, 8:] = windows.min()  # the last one stays half hidden
    windows[:3], windows[1], windows[2, 3, 3] = 0, 255, 255
    fits = fit_ellipses(windows, corners, NOISE, FIT)
    assert not fits.good.any()
    for name in ("centres", "covariances", "shapes", "shape_covariances", "contrast", "misfits"):
        assert np.isfinite(getattr(fits, name)).all()


def test_radii_are_kept_between_their_bounds():
    matrix = np.array([[4.0, 1.5], [1.5, 0.9]])
    xx, xy, yy = bound_radii(4.0, 1.5, 0.9, 0.5, 3.0)
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose(
        [[xx, xy], [xy, yy]], vectors @ np.diag(np.clip(values, 0.5, 3.0)) @ vectors.T
    )


@pytest.mark.parametrize(
    ("noise", "scale", "psf_px"), [(NOISE, 1.0, 0.0), (NOISE, 1.0, 0.6), (FINE, 16.0, 0.0)]
)
@pytest.mark.slow
def test_bound_is_that_of_numerically_differentiated_images(noise, scale, psf_px):
    """Fisher information of normal grey values with mean m and variance v(m), differentiated by all
    7 unknowns.
    """
    contrast, ground, step = scale * 180.0, scale * 22.0, 1e-5
    for centre, shape in (
        (np.array([6.31, 6.74]), np.array([[3.6, 0.5], [0.5, 2.4]])),
        (np.array([6.5, 6.02]), 2.5 * np.eye(2)),
    ):

        def image(p):
            share = coverage(p[None, :2], np.tensordot(p[2:5], SHAPE_BASIS, 1)[None], FIT, psf_px)[
                0
            ]
            return (p[6] + p[5] * share).ravel()

        start = np.array([*centre, shape[0, 0], shape[0, 1], shape[1, 1], contrast, ground])
        changes = [image(start + step * e) - image(start - step * e) for e in np.eye(7)]
        jacobian = np.stack(changes, axis=1) / (2.0 * step)
        variance = noise.variance(image(start))
        # the variance grows by K a grey value
        information = 1.0 / variance + 0.5 * (noise.gain / variance) ** 2
        expected = np.linalg.inv(jacobian.T @ (information[:, None] * jacobian))[:2, :2]
        bound = cramer_rao_bound(centre[None], shape[None], FIT, contrast, ground, noise, psf_px)[0]
        np.testing.assert_allclose(bound, expected, rtol=1e-4, atol=1e-4 * expected.trace())


def test_information_of_a_rounded_number_is_that_of_its_probabilities():
    """Probabilities of all 256 grey values, differentiated numerically; with little noise rounding
    decides.
    """
    for noise in (
        NOISE,
        replace(NOISE, electrons_at_white=5e4, gain=0.13 / 31, dark_noise=100.0, full_well=6e4),
    ):
        for mean in (22.0, 22.37, 22.5, 120.2, 254.9):

            def probabilities(mean, noise=noise):
                edges = np.concatenate([[-np.inf], np.arange(255) + 0.5, [np.inf]])
                return np.diff(norm.cdf(edges, mean, np.sqrt(noise.variance(mean) - 1.0 / 12.0)))

            slope = (probabilities(mean + 1e-4) - probabilities(mean - 1e-4)) / 2e-4
            likely = probabilities(mean) > 1e-10
            expected = np.sum(slope[likely] ** 2 / probabilities(mean)[likely])
            assert grey_value_information(np.array([mean]), noise)[0] == pytest.approx(
                expected, rel=1e-4
            )


def rising(seed, count, rise, fine=12):
    """Noisy windows of ellipses on which the light rises by up to ``rise`` a px, and their centres.

    Drawn by fine samples, each inside or outside.
    """
    rng = np.random.default_rng(seed)
    centres, shapes = random_ellipses(rng, count, SIZE, (3.8, 2.8))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    slopes = rise * np.stack([np.cos(angle), np.sin(angle)], -1)
    ticks = (np.arange(SIZE * fine) + 0.5) / fine - 0.5
    away = np.stack(np.meshgrid(ticks, ticks), -1) - centres[:, None, None]
    inside = np.linalg.norm(away @ np.linalg.inv(shapes)[:, None], axis=-1) < 1.0
    lit = 1.0 + np.einsum("nijk,nk->nij", away, slopes)
    radiance = lit * (8.0 + 200.0 * inside) / 255.0
    radiance = radiance.reshape(count, SIZE, fine, SIZE, fine).mean(axis=(2, 4))
    return NOISE.expose(radiance.astype(np.float32), rng), centres


@pytest.mark.slow
def test_light_that_rises_across_a_sticker_is_fitted_with_it():
    """By 6 % a px, half of it across a radius. The error is that which the covariance states; even
    light would put the centres six deviations off.
    """
    windows, centres = rising(2, 150, 0.06)
    corners = np.zeros((150, 2), dtype=int)
    even, lit = (fit_ellipses(windows, corners, NOISE, FIT, lit=lit) for lit in (False, True))
    assert lit.good.all()
    require_true(squares(lit.centres - centres, lit.covariances), 2)
    assert np.median(squares(even.centres - centres, even.covariances)) > 36.0
    assert np.mean(lit.misfits) == pytest.approx(1.0, abs=0.03)


def test_a_fit_tells_how_light_would_move_its_centre():
    """The shift is that of the fit with light, for little of it; without light it is as large as
    its own covariance says.
    """
    windows, _ = rising(3, 150, 0.01)
    corners = np.zeros((150, 2), dtype=int)
    even, lit = (fit_ellipses(windows, corners, NOISE, FIT, lit=lit) for lit in (False, True))
    shifts = lit.centres - even.centres
    assert np.std(even.lights[:, :2] - shifts) < 0.1 * np.std(shifts)
    windows, _ = rising(4, 150, 0.0)
    lights = fit_ellipses(windows, corners, NOISE, FIT).lights
    require_true(squares(lights[:, :2], lights[:, [[2, 3], [3, 4]]]), 2)
