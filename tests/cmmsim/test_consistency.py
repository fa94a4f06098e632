"""Stickers that contradict the others: found by sampling noise without images."""

import numpy as np
import pytest
from scipy.stats import kstest

from cmmsim.errors import LostError
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import apply, pose_to_transform
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import triangulate
from cmmsim.pose_estimation.consistency import FEWEST, LARGEST_MISFIT, consistent, outline_misfits, place_misfits
from cmmsim.pose_estimation.observation import DetectionSettings, Observer, Outlines, StickerObservation
from tests.cmmsim.sensors import NOISE
from tests.cmmsim.test_covariance import BODY, CAMERA_FROM_BASE, FILE, RIG, pixel_covariances

RADIUS = 0.003
CAMERA_FROM_BODY = CAMERA_FROM_BASE @ pose_to_transform(FILE.platform.home)
OBSERVER = Observer(RIG, NOISE, DetectionSettings(radius=RADIUS))
PIXELS = RIG.project(apply(CAMERA_FROM_BODY, BODY.nominal))[0]
SHAPES = sticker_outlines(RIG, CAMERA_FROM_BODY, BODY.nominal, BODY.sticker_normals, RADIUS)[1]


def observed(rng, stickers, shift_px=0.0, shrink_px=0.0):
    """Stickers with pixel noise; the first one's left centre is shifted along the epipolar line, its shape shrunk."""
    stickers = np.asarray(stickers)
    spread = [pixel_covariances(rng, len(stickers)) for _ in range(2)]
    pixels = [
        q[stickers] + np.einsum("nij,nj->ni", np.linalg.cholesky(s), rng.standard_normal((len(stickers), 2)))
        for q, s in zip(PIXELS, spread, strict=True)
    ]
    pixels[0][0, 0] += shift_px
    seen = triangulate(RIG, *pixels, *spread)
    shapes = SHAPES[:, stickers].copy()
    shapes[0, 0, 0, 0] -= shrink_px
    outlines = Outlines(shapes, np.broadcast_to(0.01**2 * np.eye(3), (2, len(stickers), 3, 3)))
    return StickerObservation(stickers, *pixels, seen.points, seen.covariances, outlines)


@pytest.mark.parametrize("stickers", [range(18), [0, 5, 7, 12, 16]])
def test_place_misfits_are_chi_square(stickers):
    """Three degrees of freedom each, however few stickers share the fit."""
    rng, found = np.random.default_rng(1), []
    for _ in range(1000):
        seen = observed(rng, stickers)
        places = BODY.nominal[seen.index]
        result = register(places, seen.points, seen.covariances)
        found.append(place_misfits(result, seen.points, places, seen.covariances))
    for k in range(len(found[0])):
        assert kstest(np.array(found)[:, k], "chi2", args=(3,)).pvalue > 1e-4


@pytest.mark.parametrize(("seed", "wrong"), [(2, {"shift_px": 0.5}), (3, {"shrink_px": 0.1})])
def test_displaced_or_misshapen_sticker_is_left_out(seed, wrong):
    seen = observed(np.random.default_rng(seed), range(18), **wrong)
    used, _ = consistent(seen, OBSERVER, BODY, BODY.nominal)
    np.testing.assert_array_equal(used.index, range(1, 18))


def test_three_stickers_are_refused_and_four_of_which_one_is_wrong():
    with pytest.raises(LostError, match=f"3 visible stickers, at least {FEWEST} are needed"):
        consistent(observed(np.random.default_rng(5), [0, 7, 12]), OBSERVER, BODY, BODY.nominal)
    with pytest.raises(LostError, match=r"4 visible stickers contradict each other, 3 are left .* squared misfit"):
        consistent(observed(np.random.default_rng(4), [0, 5, 7, 12], shift_px=1.0), OBSERVER, BODY, BODY.nominal)


def test_good_stickers_are_kept():
    rng = np.random.default_rng(6)
    left = [len(consistent(observed(rng, range(18)), OBSERVER, BODY, BODY.nominal)[0].index) for _ in range(500)]
    assert np.mean(left) > 18.0 * (1.0 - 5e-4)


def test_outline_misfit_is_in_units_of_its_noise():
    seen = observed(np.random.default_rng(7), range(18), shrink_px=0.03)
    misfits = outline_misfits(seen, SHAPES)
    assert misfits[0, 0] == pytest.approx(9.0)
    assert misfits[1].max() == 0.0
    assert 21.0 < LARGEST_MISFIT < 21.2


def test_drifted_camera_enlarges_the_covariance():
    """Residuals of twice the stated noise: all stickers are kept, and all covariances are four times as large."""
    rng = np.random.default_rng(9)
    seen = observed(rng, range(18))
    doubled = StickerObservation(
        seen.index, seen.left_pixels, seen.right_pixels, seen.points, seen.covariances / 4.0, seen.outlines
    )
    plain, scaled = (consistent(s, OBSERVER, BODY, BODY.nominal) for s in (seen, doubled))
    assert len(scaled[0].index) == 18
    freedom = 3 * 18 - 6
    factor = plain[1].misfit.sum() / freedom
    np.testing.assert_allclose(scaled[1].covariance, factor * plain[1].covariance, rtol=1e-6)
    np.testing.assert_allclose(scaled[0].covariances, factor * plain[0].covariances, rtol=1e-6)
