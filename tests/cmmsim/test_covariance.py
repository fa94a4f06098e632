"""Stickers with drawn pixel noise, without images: covariance of their poses, and those that contradict the others.

Also what both cameras can look for, and the covariance expected there, against what the sensor measures.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import cmmsim
from cmmsim.errors import LostError
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.files.setup import marked_body
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import apply, compose_covariance, pose_covariance, pose_to_transform, transform_to_pose
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import toed_in_rig, triangulate
from cmmsim.pose_estimation.consistency import FEWEST, LARGEST_MISFIT, consistent, outline_misfits, place_misfits
from cmmsim.pose_estimation.estimator import by_planes, by_registration
from cmmsim.pose_estimation.observation import DetectionSettings, Observer, Outlines, StickerObservation
from cmmsim.visibility import expected_covariance, sight_lines
from tests.cmmsim.sensors import CAMERA, NOISE, require_regions, require_true, squares

FILE = read_sensor_file("ctrack780")
BODY = marked_body("platform", FILE.platform)
RIG, CAMERA_FROM_BASE = toed_in_rig(CAMERA, 1.0, np.array(FILE.rig.position), np.array(FILE.rig.target))
BASE_FROM_CAMERA = np.linalg.inv(CAMERA_FROM_BASE)
POSES = [
    FILE.platform.home,
    (0.008, -0.009, 0.195, 0.04, -0.03, 0.035),
    (-0.009, 0.006, 0.208, -0.03, 0.035, -0.04),
]


def pixel_covariances(rng, count):
    """Unlike ones, as tilted stickers have them: 0.006 to 0.012 px along their axes."""
    turn = Rotation.from_rotvec(rng.uniform(0.0, np.pi, (count, 1)) * [[0.0, 0.0, 1.0]]).as_matrix()[:, :2, :2]
    return turn @ (np.eye(2) * rng.uniform(0.006, 0.012, (count, 1, 2)) ** 2) @ turn.transpose(0, 2, 1)


def observed(rng, pixels, spread, stickers):
    """Stickers (n,) at pixels (2, n, 2) with drawn noise of covariances (2, n, 2, 2)."""
    left, right = (
        q + np.einsum("nij,nj->ni", np.linalg.cholesky(s), rng.standard_normal(q.shape))
        for q, s in zip(pixels, spread, strict=True)
    )
    seen = triangulate(RIG, left, right, *spread)
    return StickerObservation(stickers, left, right, seen.points, seen.covariances, np.full(len(stickers), np.nan))


def drawn(pose, count):
    """True camera_from_body, and observations of all stickers."""
    rng, camera_from_body = np.random.default_rng(7), CAMERA_FROM_BASE @ pose_to_transform(pose)
    pixels = RIG.project(apply(camera_from_body, BODY.nominal))[0]
    spread = [pixel_covariances(rng, 18) for _ in range(2)]
    return camera_from_body, [observed(rng, pixels, spread, np.arange(18)) for _ in range(count)]


@pytest.mark.parametrize(
    ("method", "count"),
    [("registration", 2000), ("planes", 300), pytest.param("planes", 2000, marks=pytest.mark.thorough)],
)
@pytest.mark.parametrize("pose", POSES, ids=["home", "corner", "other corner"])
def test_pose_covariance(pose, method, count):
    camera_from_body, every = drawn(pose, count)
    errors, covariances = [], []
    for seen in every:
        if method == "planes":
            found, covariance, _ = by_planes(seen, BODY, BODY.normals @ camera_from_body[:3, :3].T)
        else:
            found, covariance, _ = by_registration(seen, BODY.nominal)
        base_from_body = BASE_FROM_CAMERA @ found
        errors.append(transform_to_pose(base_from_body) - pose)
        covariances.append(pose_covariance(base_from_body, compose_covariance(BASE_FROM_CAMERA, covariance)))
    errors, covariances = np.array(errors), np.array(covariances)
    squared = squares(errors, covariances)
    require_true(squared)
    require_regions(squared)
    assert np.abs(errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(count))).max() < 4.5  # no bias


ALL, RADIUS, HOME = list(range(18)), 0.003, np.array(FILE.platform.home)
CAMERA_FROM_BODY = CAMERA_FROM_BASE @ pose_to_transform(HOME)
OBSERVER = Observer(RIG, NOISE, DetectionSettings(radius=RADIUS))
PIXELS = RIG.project(apply(CAMERA_FROM_BODY, BODY.nominal))[0]
SHAPES = sticker_outlines(RIG, CAMERA_FROM_BODY, BODY.nominal, BODY.sticker_normals, RADIUS)[1]


def seen_from_home(rng, stickers, shift_px=0.0, shrink_px=0.0):
    """Stickers with pixel noise; the first one's left centre is shifted along the epipolar line, its shape shrunk."""
    pixels, shapes = PIXELS[:, stickers], SHAPES[:, stickers]
    pixels[0, 0, 0] += shift_px
    shapes[0, 0, 0, 0] -= shrink_px
    outlines = Outlines(shapes, np.broadcast_to(0.01**2 * np.eye(3), (2, len(stickers), 3, 3)))
    spread = [pixel_covariances(rng, len(stickers)) for _ in range(2)]
    return replace(observed(rng, pixels, spread, np.array(stickers)), outlines=outlines)


@pytest.mark.parametrize("stickers", [ALL, [0, 5, 7, 12, 16]])
def test_place_misfits_are_chi_square(stickers):
    """Three degrees of freedom each, however few stickers share the fit."""
    rng, found = np.random.default_rng(1), []
    for _ in range(1000):
        seen = seen_from_home(rng, stickers)
        places = BODY.nominal[seen.index]
        result = register(places, seen.points, seen.covariances)
        found.append(place_misfits(result, seen.points, places, seen.covariances))
    for k in range(len(found[0])):
        assert kstest(np.array(found)[:, k], "chi2", args=(3,)).pvalue > 1e-4


def test_place_misfits_are_those_of_plain_numpy():
    """By the whole covariance S - J C J' of each residual, of one registration and of two at once."""
    rng, seen = np.random.default_rng(4), [seen_from_home(np.random.default_rng(k), ALL) for k in range(2)]
    places = BODY.nominal[seen[0].index]
    fits = [register(places, one.points, one.covariances) for one in seen]
    plain = []
    for one, fit in zip(seen, fits, strict=True):
        turned = places @ fit.transform[:3, :3].T
        residuals = one.points - turned - fit.transform[:3, 3]
        turns = np.cross(np.eye(3), turned[:, None]).swapaxes(1, 2)
        slopes = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), turns], axis=2)
        left = one.covariances - slopes @ fit.covariance @ slopes.swapaxes(1, 2)
        plain.append(np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(left), residuals))
        found = place_misfits(fit, one.points, places, one.covariances)
        np.testing.assert_allclose(found, plain[-1], rtol=1e-8)
    both = replace(
        fits[0], transform=np.stack([f.transform for f in fits]), covariance=np.stack([f.covariance for f in fits])
    )
    order = rng.permutation(2 * len(places))
    points, spread = (np.concatenate([getattr(o, n) for o in seen])[order] for n in ("points", "covariances"))
    of, sticker = np.divmod(order, len(places))
    found = place_misfits(both, points, places[sticker], spread, of)
    np.testing.assert_allclose(found, np.concatenate(plain)[order], rtol=1e-8)


@pytest.mark.parametrize(("seed", "wrong"), [(2, {"shift_px": 0.5}), (3, {"shrink_px": 0.1})])
def test_displaced_or_misshapen_sticker_is_left_out(seed, wrong):
    seen = seen_from_home(np.random.default_rng(seed), ALL, **wrong)
    used, _ = consistent(seen, OBSERVER, BODY, BODY.nominal)
    np.testing.assert_array_equal(used.index, ALL[1:])


def test_three_stickers_are_refused_and_four_of_which_one_is_wrong():
    with pytest.raises(LostError, match=f"3 visible stickers, at least {FEWEST} are needed"):
        consistent(seen_from_home(np.random.default_rng(5), [0, 7, 12]), OBSERVER, BODY, BODY.nominal)
    with pytest.raises(LostError, match=r"4 visible stickers contradict each other, 3 are left .* squared misfit"):
        consistent(seen_from_home(np.random.default_rng(4), [0, 5, 7, 12], shift_px=1.0), OBSERVER, BODY, BODY.nominal)


def test_outline_misfit_is_in_units_of_its_noise():
    seen = seen_from_home(np.random.default_rng(7), ALL, shrink_px=0.03)
    misfits = outline_misfits(seen, SHAPES)
    assert misfits[0, 0] == pytest.approx(9.0)
    assert misfits[1].max() == 0.0
    assert 21.0 < LARGEST_MISFIT < 21.2


def test_drifted_camera_enlarges_the_covariance():
    """Residuals of twice the stated noise: all stickers are kept, and all covariances are four times as large."""
    seen = seen_from_home(np.random.default_rng(9), ALL)
    doubled = replace(seen, covariances=seen.covariances / 4.0)
    plain, scaled = (consistent(s, OBSERVER, BODY, BODY.nominal) for s in (seen, doubled))
    assert len(scaled[0].index) == 18
    factor = plain[1].misfit.sum() / (3 * 18 - 6)
    np.testing.assert_allclose(scaled[1].covariance, factor * plain[1].covariance, rtol=1e-6)
    np.testing.assert_allclose(scaled[0].covariances, factor * plain[0].covariances, rtol=1e-6)


def test_all_stickers_are_visible_at_home_and_few_with_the_platform_turned_away_or_beyond_the_image():
    sight = sight_lines("ctrack780")
    assert sight.visible(HOME).all()
    assert not sight.visible(HOME + np.array([0, 0, 0, 0, 0, np.pi / 2])).all()
    assert not sight.visible(HOME + np.array([0, 0, 0, 0, np.pi, 0]))[sight.platform.plane_index == 0].any()
    narrow = replace(sight.rig, left=replace(sight.rig.left, focal_px=12 * sight.rig.left.focal_px))
    assert not replace(sight, rig=narrow).visible(HOME).all()


@pytest.mark.parametrize("method", ["registration", "planes"])
def test_expected_covariance_is_the_one_the_taught_sensor_states(method, taught):
    sensor = cmmsim.load_sensor("ctrack780", method=method, taught=taught, renderer="analytic")
    stated = sensor.measure(HOME).covariance
    expected = expected_covariance("ctrack780", HOME, method)
    np.testing.assert_allclose(np.sqrt(np.diag(expected) / np.diag(stated)), 1.0, atol=0.05)
