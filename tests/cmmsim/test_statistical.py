"""A sensor without images against one with them: the same estimator on the same stickers, and the
same errors.

The long proof looks at 5,000 poses of each of three sensors with and without images. Of 5,000
normalised errors the two-sample Kolmogorov-Smirnov test at 1 in 1,000 finds covariances that are
wrong by 10 % in 99 of 100 cases, and the means of whitened errors a bias of 0.1 standard
deviations.
"""

import numpy as np
import pytest
from scipy.stats import chi2, chi2_contingency, ks_2samp, kstest

import cmmsim
from cmmsim.detection.ellipse_fit import fit_settings, lies_inside
from cmmsim.geometry.disc_image import SHAPE_BASIS
from cmmsim.geometry.pose import invert, pose_to_transform
from cmmsim.measuring.solver_kernels import COLUMNS, LEFT, SEEN, STATE
from cmmsim.measuring.sticker_windows import StickerObservation
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig
from cmmsim.without_images.drawn_fit_kernels import fit_covariances, tabulated
from cmmsim.without_images.drawn_frame_kernels import (
    MEASURED,
    measure_frame,
    observe,
    triangulate_stickers,
)
from cmmsim.without_images.drawn_stickers import THIN_PX, THIN_STD_PX
from cmmsim.without_images.statistical_tracker import StatisticalTracker
from cmmsim.without_images.verified import LONGEST_STREAK_PX
from tests.cmmsim import plain
from tests.cmmsim.sensors import (
    LENSES,
    camera_from,
    exact,
    pose_errors,
    random_ellipses,
    refused,
    require_true,
    squares,
)

# m, rad: of the poses, at which many stickers are seen at grazing incidence
REACH = np.repeat([0.06, 0.3], 3)
FAR = {
    "rig.distance": 2.2,
    "stickers.radius": 0.0045,
    "stickers.ring_radius": 0.0125,
    "stickers.per_plane": 8,
    "camera.dark_noise": 45.0,
}
SENSORS = {"plain": ("perfect", {}), "lens": ("all", {}), "far": ("distorted", FAR)}


def poses_of(sensor, count, seed=5):
    return sensor.home + np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6)) * REACH


def statistical(lens="perfect", changes=None, **arguments):
    return exact(lens, changes, renderer="statistical", **arguments)


@pytest.mark.parametrize("lens", ["perfect", "all"])
def test_what_is_found_in_windows_is_what_a_fit_states_of_the_nearest_stickers(lens):
    """NumPy's own lines, window by window, some of which hold a part of a sticker, or none."""
    sensor, rng, counted = (
        statistical(lens, {"timing.exposure": 0.004}),
        np.random.default_rng(3),
        0,
    )
    observer, size = sensor.observer, 16
    noise, fit_size = observer.noise, observer.settings.fit_size
    settings = fit_settings(noise, observer.settings.optics.psf_px)
    for pose in poses_of(sensor, 8):
        look = sensor.look(pose, pose_rate=np.full(6, 0.02))
        seen = look._found
        corners = np.rint(
            seen.centres - 0.5 * (size - 1) + rng.uniform(-3.0, 3.0, seen.centres.shape)
        ).astype(int)
        corners[:, ::7] += 300
        found = look.detected(corners, size, observer)
        for k, (side, n) in enumerate(np.ndindex(corners.shape[:2])):
            gaps = np.abs(seen.centres[side] - corners[side, n] - 0.5 * (size - 1)).max(axis=1)
            nearest = np.where(seen.seen[side], gaps, np.inf).argmin()
            centre, shape, drawn = (
                each[side, nearest] for each in (seen.centres, seen.shapes, seen.noise)
            )
            first = corners[side, n]
            inner = np.clip(np.rint(centre - 0.5 * (fit_size - 1)), first, first + size - fit_size)
            contrast, ground = look.camera.greys(noise, side, centre[None])
            thin = np.linalg.eigvalsh(shape)[0] > THIN_PX + THIN_STD_PX * drawn[5]
            inside = lies_inside((centre - inner)[None], shape[None], fit_size)[0]
            assert found.good[k] == (
                thin and inside and contrast[0] >= observer.settings.limits.smallest_contrast
            )
            if not found.good[k]:
                continue
            spread, smear = np.empty((1, 5, 5)), seen.smears[side, nearest][None]
            fit_covariances(
                (centre - inner)[None],
                shape[None],
                smear,
                contrast,
                ground,
                fit_size,
                settings,
                spread,
            )
            off, counted = np.linalg.cholesky(spread[0]) @ drawn[:5], counted + 1
            np.testing.assert_allclose(found.centres[k], centre + off[:2], rtol=0, atol=1e-9)
            off_shape = np.tensordot(off[2:], SHAPE_BASIS, 1)
            np.testing.assert_allclose(found.shapes[k], shape + off_shape, rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.covariances[k], spread[0, :2, :2], rtol=1e-9)
            np.testing.assert_allclose(found.shape_covariances[k], spread[0, 2:, 2:], rtol=1e-9)
            assert (found.contrast[k], found.ground[k]) == (contrast[0], ground[0])
    assert counted > 100


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("lens", ["perfect", "all"])
def test_the_estimator_says_the_same_of_the_same_stickers(lens, known):
    """Triangulation, registration and the checks of the estimator, on what one frame holds;
    stickers that the compiled code leaves out are those that the estimator leaves out. The rig that
    measures may be wrong."""
    sensor = statistical(lens)
    if known:
        rig = KnownRig.drawn(sensor.rig, 0.05**2 * PHOTOGRAPHED, np.random.default_rng(2))
        sensor = cmmsim.load_sensor(
            "ctrack780", renderer="statistical", changes=LENSES[lens], known=rig
        )
    estimator, rng, compared, left_out = sensor.estimator, np.random.default_rng(1), 0, 0
    tracker = StatisticalTracker(estimator)
    for pose in poses_of(sensor, 40):
        seen, frame, found, spread = (
            sensor.look(pose),
            tracker._frame(),
            np.empty(6),
            np.empty((6, 6)),
        )
        noise = rng.standard_normal((2, 18, 3))
        noise[0, 3, :2] += 6.0 * (
            rng.random() < 0.5
        )  # a sticker that now and then contradicts the others
        verdict = np.empty(COLUMNS)
        scene, kept = tracker._scene_of(seen.camera), np.ones(18, bool)
        draws = seen.exposed, seen.bodies, noise, kept
        near = invert(estimator.taught.base_from_camera) @ pose_to_transform(pose)
        observe(scene, *draws, frame)
        triangulate_stickers(scene, near, frame)
        index, settings = np.flatnonzero(frame.stickers.used), estimator.settings
        measure_frame(scene, *draws, frame, found, spread, verdict)
        if verdict[STATE] != MEASURED:
            continue
        pixels, spreads = frame.pixels.swapaxes(0, 1), frame.spreads.swapaxes(0, 1)
        pixels, spreads = pixels[:, index], spreads[:, index]
        points, covariances = plain.triangulate(
            estimator.rig, pixels, spreads, frame.stickers.points[index], settings.line_error_px**2
        )
        observed = StickerObservation(
            *(index, *pixels, points, covariances, 0.25 * np.einsum("ckii->k", spreads)),
            frame.stickers.rays[index],
        )
        expected = estimator.measured(observed, near)[0]
        used = frame.stickers.used
        assert list(expected.target_ids) == list(estimator.platform.sticker_ids[used])
        left_out += verdict[LEFT] < verdict[SEEN]
        assert np.abs(expected.pose - found).max() < (1e-7 if known else 5e-9)
        unit = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
        assert np.abs((expected.covariance - spread) / unit).max() < (3e-3 if known else 2e-4)
        compared += 1
    assert compared > 35
    assert left_out > 0


@pytest.mark.parametrize("light", [1.0, 0.8])
def test_the_table_is_what_the_fit_states(light):
    """Of ellipses of any kind, with the mean over places within a pixel and any light; to 2 % in a
    direction, rms.
    """
    sensor = statistical("all")
    noise = StatisticalTracker(sensor.estimator)._scene_of(sensor.camera).noise
    _, shapes = random_ellipses(np.random.default_rng(0), 60, noise.fit_size, radii=(3.8, 1.4))
    mean, found = np.zeros((60, 2, 2)), np.empty((60, 5, 5))
    places = (np.arange(4) + 0.5) / 4 - 0.5
    greys = np.full(60, light * noise.contrast), np.full(60, noise.black + light * noise.ring)
    for shift in np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2):
        centres = np.tile(0.5 * (noise.fit_size - 1) + shift, (60, 1))
        fit_covariances(
            centres, shapes, np.zeros((60, 2)), *greys, noise.fit_size, noise.settings, found
        )
        mean += found[:, :2, :2] / 16
    entries = [
        tabulated(
            noise.table,
            noise.first,
            noise.steps,
            noise.by_light,
            *shape[[0, 0, 1], [0, 1, 1]],
            light,
        )
        for shape in shapes
    ]
    table = np.array(entries)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(mean))
    wrong = np.linalg.eigvalsh(whiten @ table @ whiten.swapaxes(1, 2)) - 1.0
    assert np.sqrt(np.mean(wrong**2)) < 0.02


def test_many_at_once_are_as_many_one_by_one():
    """The same errors in units of their covariances, and stickers, of other draws."""
    sensor = statistical()
    poses = poses_of(sensor, 2000)
    together = sensor.measure_many(poses)
    alone = [sensor.measure(pose) for pose in poses[:500]]
    assert together.stickers.min() > 0
    require_true(squares(together.poses - poses, together.covariances))
    require_true(
        np.array([squares(m.pose - p, m.covariance) for m, p in zip(alone, poses, strict=False)])
    )
    assert abs(np.mean([len(m.target_ids) for m in alone]) - together.stickers[:500].mean()) < 0.1


def test_stickers_outside_of_an_image_do_not_widen_the_covariance():
    """Fewer than half of the stickers lie in both images; the stated errors are those of images."""
    drawing, without = exact(), statistical()
    pose = drawing.home + np.array([0.0, 0.7, 0.0, 0.0, 0.0, 0.0])
    images = drawing.estimator.measure(drawing.look(pose), camera_from(drawing, pose))[0]
    drawn = without.measure(pose)
    assert len(images.target_ids) == len(drawn.target_ids) < 9
    assert abs(np.trace(drawn.covariance) / np.trace(images.covariance) - 1.0) < 0.05


def test_many_by_planes_are_those_of_frames_alone():
    """In motion, with one out of sight."""
    sensor = statistical(changes={"timing.exposure": 0.002}, method="planes")
    poses, rates = (
        poses_of(sensor, 6) * np.where(np.arange(6) == 3, 5.0, 1.0)[:, None],
        np.full((6, 6), 0.1),
    )
    together = sensor.measure_many(poses, rates)
    sensor.start_run(0)
    for k, (pose, rate) in enumerate(zip(poses, rates, strict=True)):
        images = sensor.look(pose, pose_rate=rate)
        if k == 3:
            assert np.isnan(together.poses[k]).all()
        else:
            alone = sensor.estimator.measure(images, camera_from(sensor, pose))[0]
            np.testing.assert_allclose(together.poses[k], alone.pose, atol=1e-12)


def test_a_run_is_the_same_again_and_drops_frames():
    sensor = statistical(changes={"timing.dropout": 0.2})
    poses, runs = poses_of(sensor, 1500), []
    for _ in range(2):
        sensor.start_run(3)
        runs.append((sensor.measure_many(poses), [sensor.measure(pose) for pose in poses[:30]]))
    assert np.array_equal(runs[0][0].poses, runs[1][0].poses, equal_nan=True)
    assert [m.ok for m in runs[0][1]] == [m.ok for m in runs[1][1]]
    assert 0.15 < np.mean(np.isnan(runs[0][0].poses[:, 0])) < 0.25
    assert not all(m.ok for m in runs[0][1])


def test_it_is_taught_and_measures_with_a_rig_that_drifts():
    """Teaching finds the frames to microns without images; a shift of the right image moves poses
    as with images.
    """
    sensor = cmmsim.load_sensor("ctrack780", seed=4, renderer="statistical")
    wrong = sensor.taught.base_from_camera @ invert(sensor.truth.base_from_camera)
    assert np.abs(wrong - np.eye(4)).max() < 2e-5
    drawing = cmmsim.load_sensor("ctrack780", seed=4, renderer="analytic", taught=sensor.taught)
    moved = []
    for one in (sensor, drawing):
        one.move_rig({"right.cx_px": 0.03})
        moved.append(np.mean([one.measure(one.home).pose - one.home for _ in range(20)], axis=0))
    assert np.abs(moved[0]).max() > 1e-5
    assert np.abs(moved[0] - moved[1])[:3].max() < 3e-6
    assert np.abs(moved[0] - moved[1])[3:].max() < 1.5e-5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"detection.detector": "dual_conic"},
            "not verified for detection.detector 'dual_conic', only for maximum_like",
        ),
        ({"camera.noise": False}, "not verified for camera.noise false"),
        ({"camera.prnu": 0.01}, "not verified for camera.prnu 0.01"),
        (
            {"camera.dark_noise": 5.79},
            "not verified for noise of .* grey values in the dark, only for at least 1.2, here "
            "camera.dark_noise of 5.8 electrons in place of 5.79;",
        ),
        (
            {"camera.electrons_at_white": 2500.0, "camera.full_well": 4000.0},
            "not verified for rings and stickers of",
        ),
        ({"lens.psf_px": 2.0}, "not verified for lens.psf_px 2, only for at most 0.8;"),
        (
            {"stickers.ring_radius": 0.005},
            "not verified for stickers.ring_radius 0.005 m, only for at least 2.4",
        ),
    ],
)
def test_what_it_was_not_proved_for_is_refused(changes, message):
    sensor = statistical(changes=changes)
    refused(lambda: sensor.measure(sensor.home), message)


def test_the_named_limit_of_dark_noise_is_accepted():
    assert statistical(changes={"camera.dark_noise": 5.8}).camera


def test_images_are_refused():
    sensor, message = (
        statistical(),
        "'statistical' draws no images.*analytic, pyrender, scene, mitsuba draw images",
    )
    refused(lambda: sensor.capture(sensor.home), message)
    refused(lambda: sensor.look(sensor.home).windows(np.zeros((2, 1, 2), int), 16), message)
    refused(
        lambda: sensor.measure_many([sensor.home[:5]]),
        "a row of six finite numbers",
        cmmsim.CmmError,
    )


def test_long_streaks_are_refused():
    sensor = statistical(changes={"timing.exposure": 0.01})
    fast = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    message = (
        "stickers that move by .* px during the exposure, only for at most "
        f"{LONGEST_STREAK_PX:g} px"
    )
    refused(lambda: sensor.measure(sensor.home, pose_rate=fast), message)
    refused(lambda: sensor.measure_many([sensor.home], [fast]), message)


def imaged(sensor, poses):
    """Errors (n,6), covariances (n,6,6) and stickers (n,) of poses measured in images, near the
    true ones.
    """
    found = sensor.measure_many(poses)
    return found.poses - poses, found.covariances, found.stickers


@pytest.mark.parametrize(
    "count",
    [pytest.param(150, marks=pytest.mark.slow), pytest.param(5000, marks=pytest.mark.thorough)],
)
@pytest.mark.parametrize(
    "name", ["plain", *(pytest.param(n, marks=pytest.mark.thorough) for n in ("lens", "far"))]
)
def test_errors_cannot_be_told_from_those_of_images(name, count, record_property):
    drawing, without = exact(*SENSORS[name]), statistical(*SENSORS[name])
    poses = poses_of(drawing, count)
    errors, covariances, stickers = imaged(drawing, poses)
    found = without.measure_many(poses)
    both = (stickers > 0) & (found.stickers > 0)
    assert abs(np.sum(stickers > 0) - np.sum(found.stickers > 0)) <= 3 + 0.005 * count
    drawn, drawn_spread = (found.poses - poses)[both], found.covariances[both]
    ratio = np.sqrt(np.einsum("nii->ni", drawn_spread) / np.einsum("nii->ni", covariances[both]))
    record_property(
        f"statistical_std_ratio_{name}", [float(f"{value:.4f}") for value in ratio.mean(axis=0)]
    )
    assert np.abs(np.median(ratio, axis=0) - 1.0).max() < 0.01
    assert np.abs(ratio.mean(axis=0) - 1.0).max() < 0.01 + 0.3 / np.sqrt(count)
    squared = [squares(errors[both], covariances[both]), squares(drawn, drawn_spread)]
    record_property(f"statistical_nees_{name}", [float(f"{q.mean():.3f}") for q in squared])
    assert ks_2samp(*squared).pvalue > 1e-3
    assert kstest(squared[1], chi2(6).cdf).pvalue > 1e-3
    for one, spread in ((errors[both], covariances[both]), (drawn, drawn_spread)):
        white = np.linalg.solve(np.linalg.cholesky(spread), one[..., None])[..., 0]
        assert len(white) * np.sum(white.mean(axis=0) ** 2) < chi2.isf(1e-3, 6)
        assert np.abs(np.cov(white.T) - np.eye(6)).max() < 5.5 / np.sqrt(len(white))
    most = max(stickers.max(), found.stickers.max()) + 1
    counts = np.array([np.bincount(n, minlength=most) for n in (stickers, found.stickers)])
    rare = counts.sum(axis=0) < 10
    pooled = np.column_stack([counts[:, ~rare], counts[:, rare].sum(axis=1) + 1])
    assert chi2_contingency(pooled).pvalue > 1e-4, counts


@pytest.mark.slow
def test_rods_hide_the_same_stickers():
    """Three rods a frame, laid into the sight of stickers: few of the stickers are told
    differently.
    """
    sensors = exact(), statistical()
    for sensor in sensors:
        sensor.add_bodies({f"rod {k}": cmmsim.rod(0.35, 0.008) for k in range(3)})
    rng, counted, different = np.random.default_rng(9), 0, 0
    eyes = np.array([[1.44, -0.5, 1.28], [1.44, 0.5, 1.28]])
    for pose in sensors[0].home + rng.uniform(-1.0, 1.0, (40, 6)) * REACH / 3.0:
        placed = {}
        for k in range(3):
            target = (camera_to_base(sensors[0], pose))[rng.integers(18)]
            middle = (
                target
                + (eyes[rng.integers(2)] - target) * rng.uniform(0.03, 0.2)
                + rng.normal(0.0, 0.006, 3)
            )
            along = rng.normal(size=3) / 6.0
            placed[f"rod {k}"] = cmmsim.rod_transform(middle - along, middle + along)
        images = sensors[0].look(pose, placed)
        seen = set(
            sensors[0].estimator.measure(images, camera_from(sensors[0], pose))[0].target_ids
        )
        drawn = set(sensors[1].measure(pose, placed).target_ids)
        counted, different = counted + len(seen), different + len(seen ^ drawn)
    assert counted < 0.9 * 40 * 18
    assert different < 0.03 * counted


def camera_to_base(sensor, pose):
    """Nominal places (18,3) of the platform's stickers in the base frame."""
    return sensor.platform.nominal @ cmmsim.pose_to_transform(pose)[:3, :3].T + pose[:3]


@pytest.mark.slow
def test_streaks_add_as_much_to_the_covariance():
    """Up to 3 px: stated standard deviations with and without images, told the movement."""
    changes = {"timing.exposure": 0.008}
    drawing, without = exact(changes=changes), statistical(changes=changes)
    rng, ratios = np.random.default_rng(9), []
    for pose in drawing.home + rng.uniform(-1.0, 1.0, (25, 6)) * REACH / 3.0:
        rate = rng.uniform(-1.0, 1.0, 6) * np.repeat([0.1, 0.3], 3)
        ends = tuple(camera_from(drawing, pose + share * 0.008 * rate) for share in (-0.5, 0.5))
        measured = drawing.estimator.measure(
            drawing.look(pose, pose_rate=rate), camera_from(drawing, pose), ends
        )[0]
        ratios.append(
            np.diag(without.measure(pose, pose_rate=rate).covariance) / np.diag(measured.covariance)
        )
    assert np.abs(np.sqrt(np.mean(ratios, axis=0)) - 1.0).max() < 0.02


def test_the_whole_estimator_takes_it_for_images():
    """By way of windows and tracking, as `planes` does and studies of single pictures."""
    for method in ("registration", "planes"):
        sensor = statistical(method=method)
        poses = sensor.home + np.random.default_rng(0).uniform(-1.0, 1.0, (60, 6)) * REACH / 6.0
        errors, found = pose_errors(sensor, poses)
        require_true(squares(errors * 1e-6, np.array([m.covariance for m in found])))
    assert all(sensor.measure(pose).ok for pose in poses[:5])
