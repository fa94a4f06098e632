"""Stickers with drawn pixel noise, without images: covariance of their poses, and those that
contradict the others.

Also what both cameras can look for, and the covariance expected there, against what the sensor
measures.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import cmmsim
from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import marked_body
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.lens_distortion import Distortion
from cmmsim.geometry.pose import (
    apply,
    compose_covariance,
    invert,
    pose_covariance,
    pose_to_transform,
    rigid,
    transform_to_pose,
)
from cmmsim.geometry.pose_fit_kernels import residual_covariance, residual_misfit, turn_arm
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import toed_in_rig
from cmmsim.geometry.triangulation import triangulate
from cmmsim.measuring.frame_solver import (
    FEWEST,
    LARGEST_MISFIT,
    SMALLEST_SHARE,
    solve_frame,
)
from cmmsim.measuring.observation import DetectionSettings, Observer
from cmmsim.measuring.pose_estimator import by_planes, by_registration
from cmmsim.measuring.sticker_windows import Outlines, StickerObservation
from cmmsim.visibility import expected_covariance, sight_lines
from tests.cmmsim import plain
from tests.cmmsim.sensors import CAMERA, NOISE, require_regions, require_true, squares

FILE = read_sensor_file("ctrack780")
BODY = marked_body("platform", FILE.platform)
RIG, CAMERA_FROM_BASE = toed_in_rig(
    CAMERA, 1.0, np.array(FILE.rig.position), np.array(FILE.rig.target)
)
BASE_FROM_CAMERA = np.linalg.inv(CAMERA_FROM_BASE)
POSES = [
    FILE.platform.home,
    (0.008, -0.009, 0.195, 0.04, -0.03, 0.035),
    (-0.009, 0.006, 0.208, -0.03, 0.035, -0.04),
]


def pixel_covariances(rng, count):
    """Unlike ones, as tilted stickers have them: 0.006 to 0.012 px along their axes."""
    turn = Rotation.from_rotvec(
        rng.uniform(0.0, np.pi, (count, 1)) * [[0.0, 0.0, 1.0]]
    ).as_matrix()[:, :2, :2]
    return (
        turn @ (np.eye(2) * rng.uniform(0.006, 0.012, (count, 1, 2)) ** 2) @ turn.transpose(0, 2, 1)
    )


def observed(rng, pixels, spread, stickers):
    """Stickers (n,) at pixels (2, n, 2) with drawn noise of covariances (2, n, 2, 2)."""
    left, right = (
        q + np.einsum("nij,nj->ni", np.linalg.cholesky(s), rng.standard_normal(q.shape))
        for q, s in zip(pixels, spread, strict=True)
    )
    seen = triangulate(RIG, left, right, *spread)
    return StickerObservation(
        *(stickers, left, right, seen.points, seen.covariances),
        *(np.full(len(stickers), np.nan), seen.rays),
    )


def drawn(pose, count):
    """True camera_from_body, and observations of all stickers."""
    rng, camera_from_body = np.random.default_rng(7), CAMERA_FROM_BASE @ pose_to_transform(pose)
    pixels = RIG.project(apply(camera_from_body, BODY.nominal))[0]
    spread = [pixel_covariances(rng, 18) for _ in range(2)]
    return camera_from_body, [observed(rng, pixels, spread, np.arange(18)) for _ in range(count)]


@pytest.mark.parametrize(
    ("method", "count"),
    [
        ("registration", 600),
        ("planes", 150),
        pytest.param("planes", 2000, marks=pytest.mark.thorough),
    ],
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
        covariances.append(
            pose_covariance(base_from_body, compose_covariance(BASE_FROM_CAMERA, covariance))
        )
    errors, covariances = np.array(errors), np.array(covariances)
    squared = squares(errors, covariances)
    require_true(squared)
    require_regions(squared)
    assert (
        np.abs(errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(count))).max() < 4.5
    )  # no bias


ALL, RADIUS, HOME = list(range(18)), 0.003, np.array(FILE.platform.home)
CAMERA_FROM_BODY = CAMERA_FROM_BASE @ pose_to_transform(HOME)
OBSERVER = Observer(RIG, NOISE, DetectionSettings(radius=RADIUS))
PIXELS = RIG.project(apply(CAMERA_FROM_BODY, BODY.nominal))[0]
SHAPES = sticker_outlines(RIG, CAMERA_FROM_BODY, BODY.nominal, BODY.sticker_normals, RADIUS)[1]


def seen_from_home(rng, stickers, shift_px=0.0, shrink_px=0.0, slipped=0.0, apart_px=0.0):
    """Stickers with pixel noise; the first one's left centre is shifted along the epipolar line,
    its shape shrunk. The last third has ``slipped`` by some m, and the right image has moved.
    """
    pixels, shapes = PIXELS[:, stickers], SHAPES[:, stickers]
    pixels[0, 0, 0] += shift_px
    group = BODY.nominal[stickers[-(len(stickers) // 3) :]]
    here, there = (RIG.project(apply(CAMERA_FROM_BODY, group + off))[0] for off in (0.0, slipped))
    pixels[:, -len(group) :] += there - here
    pixels[1] += apart_px
    shapes[0, 0, 0, 0] -= shrink_px
    outlines = Outlines(shapes, np.broadcast_to(0.01**2 * np.eye(3), (2, len(stickers), 3, 3)))
    spread = [pixel_covariances(rng, len(stickers)) for _ in range(2)]
    return replace(observed(rng, pixels, spread, np.array(stickers)), outlines=outlines)


def solved(seen):
    """Stickers that agree, camera_from_body and its covariance, from half a millimetre beside."""
    near = CAMERA_FROM_BASE @ pose_to_transform(HOME + 5e-4)
    found = solve_frame(seen, near, OBSERVER, BODY, BODY.nominal)
    return found.used_in(0), found.camera_from_body[0], found.covariances[0]


def misfits_of(fit, points, places, covariances):
    """Squared residuals (n,) of a registration, compiled."""
    arm, gap, half, found = np.empty(3), np.empty(3), np.empty((3, 6)), []
    entries, inverse = np.empty(6), np.empty(6)
    for place, point, covariance in zip(places, points, covariances, strict=True):
        turn_arm(fit.transform, place, point, arm, gap)
        residual_covariance(arm, covariance, fit.covariance, half, entries)
        found.append(residual_misfit(gap, covariance, entries, SMALLEST_SHARE, inverse))
    return np.array(found)


@pytest.mark.parametrize("stickers", [ALL, [0, 5, 7, 12, 16]])
def test_place_misfits_are_chi_square(stickers):
    """Three degrees of freedom each, however few stickers share the fit."""
    rng, found = np.random.default_rng(1), []
    for _ in range(1000):
        seen = seen_from_home(rng, stickers)
        places = BODY.nominal[seen.index]
        result = register(places, seen.points, seen.covariances)
        found.append(misfits_of(result, seen.points, places, seen.covariances))
    for k in range(len(found[0])):
        assert kstest(np.array(found)[:, k], "chi2", args=(3,)).pvalue > 1e-4


@pytest.mark.parametrize("stickers", [ALL, [0, 1, 2, 3], [0, 6, 7]])
def test_place_misfits_are_those_of_plain_numpy(stickers):
    """By the covariance S - J C J' of each residual, without what a sticker alone determines."""
    for seed in range(20):
        seen = seen_from_home(np.random.default_rng(seed), stickers)
        places = BODY.nominal[seen.index]
        fit = register(places, seen.points, seen.covariances)
        expected = plain.place_misfits(
            fit.transform, fit.covariance, places, seen.points, seen.covariances
        )
        found = misfits_of(fit, seen.points, places, seen.covariances)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.slow
def test_the_compiled_solver_finds_what_plain_numpy_finds():
    """Frames of four to eighteen stickers, some of them displaced or misshapen, with a lens."""
    rng, lost, left_out = np.random.default_rng(0), 0, 0
    for k in range(150):
        stickers = np.sort(rng.choice(18, rng.integers(4, 19), replace=False))
        seen = seen_from_home(
            *(rng, stickers, 0.4 * (k % 3 == 0), 0.1 * (k % 5 == 0)),
            slipped=(4e-4 if k % 16 else 2e-5) * (k % 8 == 0),
            apart_px=0.03 * (k % 9 == 0),
        )
        seen = seen if k % 4 else replace(seen, outlines=None)
        seen = seen if k % 7 else replace(seen, covariances=seen.covariances / 4.0)
        expected = plain.consistent(
            *(seen, RIG, RADIUS, BODY.nominal, BODY.sticker_normals, BODY.plane_index)
        )
        if expected is None:
            with pytest.raises(LostError):
                solved(seen)
            lost += 1
            continue
        used, move, covariance = solved(seen)
        left_out += len(used.index) < len(stickers)
        np.testing.assert_array_equal(used.index, expected[0])
        np.testing.assert_allclose(move, expected[1], rtol=0, atol=1e-11)
        np.testing.assert_allclose(covariance, expected[2], rtol=1e-6, atol=1e-18)
    assert lost >= 5
    assert left_out > 40


def test_rounding_errors_of_a_predicted_place_do_not_grow_from_frame_to_frame():
    """Each frame is looked for where the two before lead to, as a tracker does, a thousand times."""
    seen = seen_from_home(np.random.default_rng(2), ALL)
    last = move = CAMERA_FROM_BODY
    for _ in range(1000):
        last, move = (
            move,
            solve_frame(
                seen, move @ invert(last) @ move, OBSERVER, BODY, BODY.nominal
            ).camera_from_body[0],
        )
    assert np.abs(move[:3, :3].T @ move[:3, :3] - np.eye(3)).max() < 1e-13
    np.testing.assert_allclose(move, solved(seen)[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("lens", [Distortion(), Distortion(-0.12, 0.03, 1e-3, -7e-4, -4e-3)])
def test_triangulated_points_are_those_of_opencvs_derivatives(lens):
    rig = replace(
        RIG, left=replace(RIG.left, distortion=lens), right=replace(RIG.right, distortion=lens)
    )
    rng, points = np.random.default_rng(3), apply(CAMERA_FROM_BODY, BODY.nominal)
    pixels = rig.project(points)[0] + 0.1 * rng.standard_normal((2, 18, 2))
    spread = np.stack([pixel_covariances(rng, 18) for _ in range(2)])
    for line_variance in (0.0, 1e-3):
        expected = plain.triangulate(rig, pixels, spread, points, line_variance)
        for near in (None, points + 1e-3):
            found = triangulate(rig, *pixels, *spread, near=near, line_variance=line_variance)
            np.testing.assert_allclose(found.points, expected[0], rtol=0, atol=1e-12)
            size = np.abs(expected[1]).max()
            np.testing.assert_allclose(found.covariances, expected[1], rtol=0, atol=5e-8 * size)


@pytest.mark.parametrize(("seed", "wrong"), [(2, {"shift_px": 0.5}), (3, {"shrink_px": 0.1})])
def test_displaced_or_misshapen_sticker_is_left_out(seed, wrong):
    seen = seen_from_home(np.random.default_rng(seed), ALL, **wrong)
    used = solved(seen)[0]
    np.testing.assert_array_equal(used.index, ALL[1:])


def test_four_stickers_are_refused_and_five_of_which_one_is_wrong():
    with pytest.raises(LostError, match=f"4 visible stickers, at least {FEWEST} are needed"):
        solved(seen_from_home(np.random.default_rng(5), [0, 5, 7, 12]))
    with pytest.raises(
        LostError, match=r"5 visible stickers contradict each other, 4 are left .* squared misfit"
    ):
        solved(seen_from_home(np.random.default_rng(4), [0, 3, 5, 7, 12], shift_px=1.0))


def test_a_frame_lost_by_the_size_of_all_residuals_says_so():
    """Seven deviations of noise in each sticker, and no sticker that differs from the others."""
    seen = seen_from_home(np.random.default_rng(9), ALL)
    with pytest.raises(LostError, match=r"the first rejected one is \w+, because the mean square"):
        solved(replace(seen, covariances=seen.covariances / 49.0))


def test_a_group_that_has_slipped_refuses_the_frame_even_if_it_is_a_third():
    seen = seen_from_home(np.random.default_rng(2), ALL, slipped=4e-4)
    with pytest.raises(LostError, match="12 visible stickers agree on one pose and 6 on another"):
        solved(seen)


def test_a_plane_that_slipped_by_a_few_deviations_widens_the_covariance():
    """Plane C has slipped, or both others have, so the pose of either is as likely to be right."""
    slip = 1.5e-5  # m, along each axis
    either = CAMERA_FROM_BODY, CAMERA_FROM_BODY @ rigid(np.eye(3), np.full(3, slip))
    usual = solved(seen_from_home(np.random.default_rng(0), ALL))[2]
    found, left_out = [], 0
    for seed in range(20):
        seen = seen_from_home(np.random.default_rng(seed), ALL, slipped=slip)
        used, move, covariance = solved(seen)
        left_out += 18 - len(used.index)
        for truth in either:
            turn = Rotation.from_matrix(move[:3, :3] @ truth[:3, :3].T).as_rotvec()
            error = np.append(move[:3, 3] - truth[:3, 3], turn)
            found.append([squares(error, usual), squares(error, covariance)])
    before, after = (np.sqrt(found) > 6.0).mean(axis=0)
    assert before > 0.5
    assert after < 0.1
    # The slip explains the worst sticker better than an error of this sticker does.
    assert left_out <= 1


def test_images_that_are_apart_widen_the_covariance_though_each_sticker_agrees():
    """A right image that is 0.04 px off moves each sticker by three deviations of its noise."""
    rng = np.random.default_rng(3)
    usual = solved(seen_from_home(rng, ALL))
    apart = solved(seen_from_home(rng, ALL, apart_px=np.array([0.02, 0.03])))
    assert len(apart[0].index) == 18
    error = np.linalg.inv(CAMERA_FROM_BODY) @ apart[1] - np.eye(4)
    assert np.linalg.norm(error[:3, 3]) > 3.0 * np.sqrt(np.trace(usual[2][:3, :3]))
    assert np.trace(apart[2]) > 10.0 * np.trace(usual[2])


def test_a_sticker_is_left_out_once_its_outline_misfits_by_the_limit():
    """The square of the change over that of its noise, 0.01 px, against the limit."""
    for change, kept in ((0.99, True), (1.01, False)):
        shrink = change * 0.01 * np.sqrt(LARGEST_MISFIT)
        seen = seen_from_home(np.random.default_rng(7), ALL, shrink_px=shrink)
        move = solved(seen)[1]  # where outlines are expected
        shapes = sticker_outlines(RIG, move, BODY.nominal, BODY.sticker_normals, RADIUS)[1]
        shapes[0, 0, 0, 0] -= shrink
        exact = replace(seen, outlines=replace(seen.outlines, shapes=shapes))
        assert (0 in solved(exact)[0].index) == kept
    assert 21.0 < LARGEST_MISFIT < 21.2


def test_drifted_camera_enlarges_the_covariance():
    """Residuals of twice the stated noise: all stickers are kept, and all covariances are four
    times as large, times what errors share that are no noise.
    """
    seen = seen_from_home(np.random.default_rng(9), ALL)
    doubled = replace(seen, covariances=seen.covariances / 4.0)
    usual, scaled = solved(seen), solved(doubled)
    assert len(scaled[0].index) == 18
    squared = plain.fitted(BODY.nominal, seen.points, seen.covariances)[2]
    factor = plain.EXCESS_SHARE * squared.sum() / (3 * 18 - 6)
    np.testing.assert_allclose(scaled[2], factor * usual[2], rtol=1e-6)
    np.testing.assert_allclose(scaled[0].covariances, factor * usual[0].covariances, rtol=1e-6)


def test_all_stickers_are_visible_at_home_and_few_with_the_platform_turned_away_or_beyond_the_image():
    sight = sight_lines("ctrack780")
    assert sight.visible(HOME).all()
    assert not sight.visible(HOME + np.array([0, 0, 0, 0, 0, np.pi / 2])).all()
    assert not sight.visible(HOME + np.array([0, 0, 0, 0, np.pi, 0]))[
        sight.platform.plane_index == 0
    ].any()
    narrow = replace(sight.rig, left=replace(sight.rig.left, focal_px=12 * sight.rig.left.focal_px))
    assert not replace(sight, rig=narrow).visible(HOME).all()


@pytest.mark.parametrize("method", ["registration", "planes"])
def test_expected_covariance_is_the_one_the_taught_sensor_states(method, taught):
    sensor = cmmsim.load_sensor("ctrack780", method=method, taught=taught, renderer="analytic")
    stated = sensor.measure(HOME).covariance
    expected = expected_covariance("ctrack780", HOME, method)
    np.testing.assert_allclose(np.sqrt(np.diag(expected) / np.diag(stated)), 1.0, atol=0.05)
