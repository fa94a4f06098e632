"""One contract for all detectors, their stated covariance and bias against sampling, and the
eccentricity of discs.
"""

from dataclasses import replace

import numpy as np
import pytest

from cmmsim.allowed_plugins import ALLOWED, DEFAULT_DETECTOR, DETECTORS
from cmmsim.detection.detector import FitLimits, SpotWindows, find_detector
from cmmsim.detector_leaderboard import Condition, compete, draw_discs, random_ellipses, scene_of
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.loading import load_sensor
from tests.cmmsim.sensors import exact, refused, require_true, squared_errors, squares

SCENE = scene_of(read_sensor_file("ctrack780"))
SIZE, FIT = 18, 14
EVERY = pytest.mark.parametrize(
    "detector", [find_detector(name) for name in DETECTORS], ids=list(DETECTORS)
)
NO_LIMIT = FitLimits(largest_misfit=np.inf)


def drawn(condition, count, seed, size=SIZE):
    """True centres, windows without noise and with it, and the noise."""
    scene, rng = SCENE.with_noise(condition.noise), np.random.default_rng(seed)
    centres, shapes = random_ellipses(condition, scene.focal_px, size, count, rng)
    radiance = draw_discs(scene, centres, shapes, size, condition.psf_px)
    return centres, scene.noise.mean_grey(radiance), scene.noise.expose(radiance, rng), scene.noise


def corners(count):
    return np.zeros((count, 2), dtype=int)


@EVERY
@pytest.mark.parametrize(
    "condition",
    [
        Condition(3.8, 0.8, 0.027),
        Condition(5.0, 0.0, 0.01),
        Condition(3.0, 0.5, 0.05),
        Condition(4.0, 0.8, 0.02, 0.6),
    ],
    ids=["working", "round", "noisy", "blurred"],
)
def test_covariance_is_that_of_sampled_noise(detector, condition):
    """Squared error of what the noise does to a centre."""
    _, clean, noisy, noise = drawn(condition, 800, 1)
    size = FIT + 2 * detector.margin_px
    found, without = (
        detector.detect(SpotWindows(w, corners(800), noise, size, NO_LIMIT, condition.psf_px))
        for w in (noisy, clean)
    )
    assert found.good.all()
    change = found.centres - without.centres
    require_true(squares(change, found.covariances), 2)
    assert np.abs(change.mean(axis=0)).max() < 4.0 * change.std() / np.sqrt(800)


@EVERY
def test_averaged_exposures_divide_the_covariance_and_no_windows_hold_no_centres(detector):
    _, clean, _, noise = drawn(Condition(3.8, 0.8, 0.027), 5, 2)
    one, many = (
        detector.detect(SpotWindows(clean, corners(5), replace(noise, frames=n), FIT))
        for n in (1, 50)
    )
    np.testing.assert_allclose(many.covariances, one.covariances / 50.0, rtol=1e-6)
    found = detector.detect(SpotWindows(np.zeros((0, SIZE, SIZE)), corners(0), SCENE.noise, FIT))
    assert (found.centres.shape, found.covariances.shape, found.good.shape) == (
        (0, 2),
        (0, 2, 2),
        (0,),
    )


@EVERY
def test_bias_is_as_stated(detector):
    """Without noise, sharp, at the radius and tilt that the stated figure is for."""
    centres, clean, _, noise = drawn(Condition(3.8, np.pi / 4.0, 0.027), 600, 3)
    error = detector.detect(SpotWindows(clean, corners(600), noise, FIT)).centres - centres
    rms = np.sqrt(np.mean(error**2))
    assert rms == pytest.approx(detector.bias_px, rel=0.1, abs=1e-5)
    assert (
        np.abs(error.mean(axis=0)).max() < 5.0 * rms / np.sqrt(600) + 1e-6
    )  # over all places in a pixel it cancels


@EVERY
def test_what_lies_beyond_the_dark_ring_does_not_matter(detector):
    """A lighter ground beyond the ring in one corner of the window, as the body shows beside a
    tilted sticker.
    """
    condition = Condition(3.8, 0.0, 0.027)
    centres, clean, _, noise = drawn(condition, 60, 5)
    ticks = np.arange(SIZE)
    away = np.hypot(ticks - centres[:, :1, None], ticks[:, None] - centres[:, 1:, None])
    beside = (away > 2.5 * condition.radius_px) & (ticks > 9)
    lit = np.where(beside, clean + 22.0, clean)
    assert beside.any(axis=(1, 2)).all()
    found, without = (
        detector.detect(SpotWindows(w, corners(60), noise, FIT)).centres for w in (lit, clean)
    )
    assert np.abs(found - without).max() < 0.002


@EVERY
def test_empty_dim_and_cut_spots_are_not_good(detector):
    _, clean, noisy, noise = drawn(Condition(3.8, 0.8, 0.027), 4, 6)
    ground = np.rint(clean.min()).astype(np.uint8)
    bad = noisy.copy()
    bad[0] = ground
    bad[1] = np.rint(ground + 0.15 * (clean[1] - ground))
    bad[2] = np.roll(noisy[2], 8, axis=1)
    bad[2, :, :4] = ground  # half of the spot is beyond the window's right side
    found = detector.detect(SpotWindows(bad, corners(4), noise, FIT))
    assert found.good.tolist() == [False, False, False, True]
    assert np.all(np.isfinite(found.centres))
    assert np.all(np.isfinite(found.covariances))


def test_scene_with_other_noise_keeps_contrast_and_ground_and_cannot_have_less_than_that_of_rounding():
    quieter = SCENE.with_noise(0.005)
    assert quieter.edge_noise == pytest.approx(0.005, rel=1e-9)
    assert (quieter.ground, quieter.contrast) == pytest.approx(
        (SCENE.ground, SCENE.contrast), rel=1e-12
    )
    shot = [
        replace(s.noise, dark_noise=0.0).variance(s.ground + s.contrast) - 1.0 / 12.0
        for s in (SCENE, quieter)
    ]
    both = [s.noise.variance(s.ground + s.contrast) - 1.0 / 12.0 for s in (SCENE, quieter)]
    # shot and dark noise in the same proportion
    assert shot[0] / both[0] == pytest.approx(shot[1] / both[1], rel=1e-9)
    refused(
        lambda: SCENE.with_noise(0.001),
        r"0\.10% of the contrast is less than the noise of rounding, 0\.16%",
    )


@pytest.mark.slow
@EVERY
def test_sensor_file_chooses_the_detector_and_poses_keep_their_covariance(
    detector, taught, moving_path
):
    """Squared pose errors along a path, normalised by the stated covariance with the detector's
    bias in it, and by that with what teaching left, which is the same whichever detector measures.
    """
    changes = {"detection.detector": detector.name}
    sensor = load_sensor("ctrack780", 1, taught=taught, renderer="analytic", changes=changes)
    path = moving_path(150)[::2]
    found = [sensor.measure(pose) for pose in path]
    assert all(m.ok for m in found)
    # neighbours share places in a pixel
    assert squared_errors(found, path).mean() == pytest.approx(6.0, rel=0.25)
    errors = np.array([m.pose for m in found]) - path
    stated = np.array([m.single_covariance for m in found])
    squared = squares(errors, stated)
    assert (
        4.0 < squared.mean() < 8.0
    )  # the mean scatters by 0.4, and one teaching is in all of them
    assert squared[0] < 22.5  # 1 in 1,000


@pytest.mark.parametrize("radius_px", [3.8, 4.4, 4.8, 5.2])
def test_lines_of_the_dual_conic_that_the_window_cuts_off_move_no_good_centre(radius_px):
    """Discs so large that their rims come near the window's sides: exact to the stated bias, or not
    good.
    """
    centres, clean, _, noise = drawn(Condition(radius_px, np.pi / 4.0, 0.027), 200, 8)
    dual_conic = find_detector("dual_conic")
    for margin_px in (0, dual_conic.margin_px):
        found = dual_conic.detect(SpotWindows(clean, corners(200), noise, 12 + 2 * margin_px))
        assert np.all(np.abs(found.centres - centres)[found.good] < 5.0 * dual_conic.bias_px)
    assert found.good.all()


def test_windows_of_the_leaderboard_have_room_for_blurred_discs():
    """The dual conic rejects discs whose rims come near the edge, and these do not."""
    blurred = Condition(3.8, 0.8, 0.02, 1.5)
    rng = np.random.default_rng(0)
    (score,) = compete(SCENE, [blurred], 20, rng, [find_detector("dual_conic")])
    assert score.lost == 0.0


class Shifted:
    """A detector of one's own that is made once: the maximum-likelihood fit, a fifth of a pixel
    aside.
    """

    bias_px, margin_px = 0.2, 1

    def __call__(self, given):
        found = find_detector(DEFAULT_DETECTOR).detect(given)
        return replace(found, centres=found.centres + np.array([0.2, 0.0]))


def test_a_detector_of_one_s_own_measures_by_its_module_and_name(monkeypatch):
    monkeypatch.setenv(ALLOWED, f"{__name__}, cmmsim")
    """Both images are shifted alike, so the platform seems to stand a little beside its place."""
    name, usual = f"{__name__}:Shifted", exact()
    sensor = exact("perfect", {"detection.detector": name})
    assert (sensor.observer.detector.bias_px, sensor.observer.detector.margin_px) == (0.2, 1)
    poses = [s.measure(s.home) for s in (usual, sensor)]
    assert all(m.ok for m in poses)
    assert np.linalg.norm(poses[1].pose[:3] - poses[0].pose[:3]) > 50e-6
    # its bias is in there
    assert np.trace(poses[1].covariance) > 100.0 * np.trace(poses[0].covariance)
    # a function, no more
    plain = find_detector("cmmsim.detection.ellipse_fit:detect_by_maximum_likelihood")
    assert (plain.bias_px, plain.margin_px) == (0.0, 0)


def nothing(given):
    """No detector: it returns something else than centres."""
    return len(given.windows)


def test_a_detector_that_returns_something_else_is_named():
    sensor = exact("perfect", {"detection.detector": f"{__name__}:nothing"})
    refused(
        lambda: sensor.measure_many([sensor.home]),
        "nothing' must return DetectedCentres, got 36 of type int",
    )


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "nowhere:detect",
            "detector 'nowhere:detect' is code of the module nowhere, which is not allowed to run",
        ),
        (
            "tests.nowhere:detect",
            "detector 'tests.nowhere:detect' cannot be imported: No module named",
        ),
        # what the module imports is not listed
        (
            f"{__name__}:missing",
            r"test_detectors\.py has no missing; it has SCENE, EVERY, NO_LIMIT, drawn, ",
        ),
        (f"{__name__}:SIZE", "is of type int, which cannot be called"),
    ],
)
def test_what_is_no_detector_is_refused(name, message):
    refused(lambda: load_sensor("ctrack780", changes={"detection.detector": name}), message)
