"""A watch over cameras that drift: false alarms, how soon a drift is noticed, and what is found of
it.

Many runs are of projected centres with noise: what lies between them and images is known to be
noise of that size (`test_covariance.py`), and images are taken for some. The true rig is another
object than the known one.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import binom, multivariate_normal

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import apply, pose_to_transform, transform_to_pose
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import PLACE_NAMES
from cmmsim.geometry.triangulation import triangulate
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.observation import faces_camera
from cmmsim.measuring.sticker_windows import StickerObservation
from cmmsim.uncertainty.common_errors import MeasuringGeometry
from cmmsim.uncertainty.drift_evidence import Filter, Finding, Movement
from cmmsim.uncertainty.drift_watch import DriftWatch
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig, rig_changes
from tests.cmmsim.sensors import exact

NOISE_PX = 0.0085  # of a centre, as of the built-in sensor
RATE = 60.0
PRINCIPAL_POINT, TOE_IN = {"right.cx_px": 0.1}, {"right_from_left.ry_rad": 2e-5}


def path(home, frames):
    """A motion (frames, 6) as of an exciting trajectory."""
    angle = 2.0 * np.pi * 0.1 / RATE * np.arange(frames)[:, None] * np.array(
        [1, 2, 3, 3, 1, 2]
    ) + np.arange(6)
    return home + np.array([0.01] * 3 + [0.04] * 3) * np.sin(angle)


@pytest.fixture(scope="module")
def geometry():
    sensor = exact()
    return MeasuringGeometry(sensor.rig, sensor.platform, sensor.base, sensor.truth, sensor.home)


def taught_wrongly(geometry, error, rig=None):
    """What is known after a rig, true minus known (24,), taught the places of the platform's
    stickers.
    """
    places = geometry.taught.platform_places + np.tensordot(error, geometry.taught_by_rig[1], 1)
    known = replace(
        geometry, rig=rig or geometry.rig, taught=replace(geometry.taught, platform_places=places)
    )
    # which changes little, and takes a second
    known.__dict__["taught_by_rig"] = geometry.taught_by_rig
    return known


def frontal(geometry):
    """Indices of the platform's stickers that both cameras see at home."""
    placed = [
        move @ geometry.camera_from_base @ pose_to_transform(geometry.home)
        for move in geometry.rig.from_camera
    ]
    places, normals = geometry.taught.platform_places, geometry.platform.sticker_normals
    return np.flatnonzero(
        np.all([faces_camera(apply(at, places), normals @ at[:3, :3].T) for at in placed], axis=0)
    )


class Projected:
    """Measures poses from centres that a true rig projects, with noise, by a geometry that is
    known.
    """

    def __init__(self, known, true_taught, rng):
        self.known, self.rng, self.index = known, rng, frontal(known)
        self.places, self.base = true_taught.platform_places[self.index], true_taught.base_places
        self.camera_from_base = np.linalg.inv(true_taught.base_from_camera)

    def _seen(self, rig, points):
        pixels = rig.project(points)[0] + NOISE_PX * self.rng.standard_normal((2, len(points), 2))
        spread = np.tile(NOISE_PX**2 * np.eye(2), (2, len(points), 1, 1))
        found = triangulate(self.known.rig, *pixels, *spread)
        return pixels, found

    def base_seen(self, rig):
        pixels, seen = self._seen(rig, apply(self.camera_from_base, self.base))
        count = len(self.base)
        return StickerObservation(
            *(np.arange(count), *pixels, seen.points, seen.covariances),
            *(np.full(count, NOISE_PX**2), seen.rays),
        )

    def measured(self, rig, pose):
        pixels, seen = self._seen(
            rig, apply(self.camera_from_base @ pose_to_transform(pose), self.places)
        )
        points, spread = seen.points, seen.covariances
        found = register(self.known.taught.platform_places[self.index], points, spread).transform
        names, variances = (
            self.known.platform.sticker_ids[self.index],
            np.full(len(points), NOISE_PX**2),
        )
        at = transform_to_pose(self.known.taught.base_from_camera @ found)
        return Measurement(
            at, np.eye(6), points, spread, *pixels, names, True, pixel_variances=variances
        )


def watched(watch, eye, true, drift, frames, last=None):
    """What a watch finds in a run whose true rig drifts by `drift` (24,) over it, of which `last`
    frames are seen.
    """
    watch.restart()
    for frame, pose in enumerate(path(watch.geometry.home, frames)[:last]):
        rig = true.moved(frame / (frames - 1) * drift)
        watch.add(eye.measured(rig, pose), eye.base_seen(rig) if watch.watches_base else None)
    return watch.finding


def cost(sensor, drift, pose):
    """Error (6,) of a pose by a drift (24,), in standard deviations of its noise: from centres
    without noise.
    """
    eye = Projected(
        MeasuringGeometry(sensor.rig, sensor.platform, sensor.base, sensor.truth, sensor.home),
        sensor.truth,
        np.random.default_rng(0),
    )
    eye.rng = type("Silent", (), {"standard_normal": staticmethod(np.zeros)})
    moved = eye.measured(sensor.rig.moved(drift), pose).pose - eye.measured(sensor.rig, pose).pose
    return moved / np.sqrt(np.diag(sensor.measure(pose).covariance))


def test_a_filter_finds_what_one_gaussian_of_all_residuals_says():
    """Two unknowns that walk and three that stand still, seen in four blocks of five residuals."""
    rng, walk, prior, frames = (
        np.random.default_rng(0),
        np.array([0.3, 0.8]),
        np.array([0.5, 1.0, 2.0]),
        [3, 1, 6, 2],
    )
    slopes, seen = rng.normal(size=(4, 5, 5)), rng.normal(size=(4, 5))
    found = Filter(prior, walk)
    for one, residuals, passed in zip(slopes, seen, frames, strict=True):
        found.step(one.T @ one, one.T @ residuals, residuals @ residuals, passed)
    passed = np.cumsum(frames)
    states = np.kron(np.minimum.outer(passed, passed), np.diag(np.append(walk, np.zeros(3)) ** 2))
    states += np.kron(np.ones((4, 4)), np.diag(np.append(np.zeros(2), prior) ** 2))
    whole = block_diag(*slopes)
    covariance, last = whole @ states @ whole.T + np.eye(20), states[15:17] @ whole.T
    expected = multivariate_normal(np.zeros(20), covariance).logpdf(seen.ravel()) + 10.0 * np.log(
        2.0 * np.pi
    )
    assert found.log_likelihood == pytest.approx(expected, rel=1e-10)
    spread = states[15:17, 15:17] - last @ np.linalg.solve(covariance, last.T)
    information, score = found.marginal_information(2)
    np.testing.assert_allclose(information, np.linalg.inv(spread), rtol=1e-9)
    np.testing.assert_allclose(
        score, information @ last @ np.linalg.solve(covariance, seen.ravel()), rtol=1e-9
    )


@pytest.mark.parametrize("base", [False, True])
def test_runs_without_drift_give_no_alarm(geometry, base):
    eye = Projected(geometry, geometry.taught, np.random.default_rng(1))
    finding = watched(DriftWatch(geometry, base=base), eye, geometry.rig, np.zeros(24), 150)
    assert finding.noticed_s is None
    assert finding.warning is None
    assert finding.movements == ()
    assert finding.frames == 150


@pytest.mark.parametrize("drift", [PRINCIPAL_POINT, TOE_IN])
def test_a_drift_is_noticed_and_named_and_recovered_to_a_fifth(geometry, drift):
    ((name, size),) = drift.items()
    eye = Projected(geometry, geometry.taught, np.random.default_rng(2))
    finding = watched(DriftWatch(geometry), eye, geometry.rig, rig_changes(drift), 400)
    first = finding.movements[0]
    assert first.name == name
    assert abs(first.amount - size) < 0.2 * size
    assert abs(first.amount - size) < 4.0 * first.std
    assert not finding.from_start
    assert name in finding.warning
    assert 0.0 < finding.noticed_s < 5.0


def test_errors_from_the_start_are_told_from_a_drift(geometry):
    """Also of a rig that was taught: what its teaching hides of them is allowed for."""
    error = rig_changes({"left.cy_px": 0.1})
    true = geometry.rig.moved(error)
    known = taught_wrongly(geometry, error)
    eye = Projected(known, geometry.taught, np.random.default_rng(3))
    finding = watched(DriftWatch(known), eye, true, np.zeros(24), 90)
    assert finding.from_start
    assert finding.noticed_s < 0.3
    assert finding.movements[0].name == "left.cy_px"
    assert finding.movements[0].amount == pytest.approx(0.1, rel=0.2)


def test_a_movement_of_the_whole_rig_shows_on_the_base_alone(geometry):
    """Both cameras, turned together by 20 urad: no test on the platform can tell that from a
    movement of it.
    """
    for base in (False, True):
        eye = Projected(geometry, geometry.taught, np.random.default_rng(4))
        turned = np.eye(4)
        turned[0, 2], turned[2, 0] = 2e-5, -2e-5
        eye.camera_from_base = turned @ eye.camera_from_base
        finding = watched(DriftWatch(geometry, base=base), eye, geometry.rig, np.zeros(24), 90)
        assert (finding.noticed_s is not None) == base
        assert ("place of the whole rig (base pose)" in finding.unseen) == (not base)
        assert "scale of rig and taught places together" in finding.unseen
    assert {one.name for one in finding.movements} <= {
        f"camera_from_base.{name}" for name in PLACE_NAMES
    }


def test_lost_frames_say_nothing_but_that_time_passes(geometry):
    watch = DriftWatch(geometry, frame_period=0.1)
    for _ in range(20):
        watch.add(lost_measurement("dark"))
    found = watch.finding
    assert (found.noticed_s, found.frames, found.judged_frames) == (None, 20, 0)
    eye = Projected(geometry, geometry.taught, np.random.default_rng(5))
    for _ in range(12):
        watch.add(
            eye.measured(geometry.rig.moved(rig_changes({"right.cy_px": 0.5})), geometry.home)
        )
    assert watch.finding.noticed_s == pytest.approx(2.5, abs=0.11)
    watch.restart()
    assert watch.finding.frames == 0


@pytest.mark.filterwarnings("error")
def test_stickers_that_only_the_last_frame_lacks_count_after_those_before(geometry):
    watch, eye = (
        DriftWatch(geometry),
        Projected(geometry, geometry.taught, np.random.default_rng(6)),
    )
    for missing in (0, 0, 0, 1):
        eye.index, eye.places = eye.index[missing:], eye.places[missing:]
        watch.add(eye.measured(geometry.rig, geometry.home))
    assert (watch.finding.frames, watch.finding.judged_frames) == (4, 4)
    assert np.isfinite(watch.finding.evidence)


def test_what_cannot_be_watched_is_refused_in_one_line(geometry):
    with pytest.raises(CmmError, match=r"between 0 and 1, got 1\.5"):
        DriftWatch(geometry, chance=1.5)
    with pytest.raises(CmmError, match="by registration only, not by planes"):
        exact(method="planes").watch_drift()


def alarms(geometry, covariance, told, runs, frames, chance, rng):
    """Number of false alarms in runs of rigs known with a covariance (24, 24), each of which taught
    itself.
    """
    found = 0
    for _ in range(runs):
        known = KnownRig.drawn(geometry.rig, covariance, rng)
        mine = taught_wrongly(geometry, geometry.rig.parameters - known.rig.parameters, known.rig)
        watch = DriftWatch(mine, known if told else None, chance=chance)
        finding = watched(
            watch, Projected(mine, geometry.taught, rng), geometry.rig, np.zeros(24), frames
        )
        found += finding.noticed_s is not None
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("share", [0.0, 1e-2])
def test_false_alarms_are_as_rare_as_stated(geometry, share):
    """Watches that allow one in ten, on 50 runs: more than 9 have a chance of 2 %. Rigs that are
    known exactly, or to a tenth of what photographs say; who is not told of that finds all of them
    wrong."""
    rng = np.random.default_rng(6)
    assert alarms(geometry, share * PHOTOGRAPHED, True, 50, 48, 0.1, rng) <= binom.isf(
        0.02, 50, 0.1
    )
    if share:
        assert alarms(geometry, share * PHOTOGRAPHED, False, 5, 24, 0.1, rng) == 5


@pytest.mark.thorough
def test_false_alarms_are_as_rare_as_stated_in_long_runs(geometry):
    """300 runs of 10 s with one in a hundred allowed: more than 8 have a chance of 0.4 %."""
    assert alarms(geometry, 0.0 * PHOTOGRAPHED, True, 300, 600, 0.01, np.random.default_rng(7)) <= 8


@pytest.mark.thorough
@pytest.mark.parametrize("drift", [PRINCIPAL_POINT, TOE_IN, {"left.cx_px": 0.1}])
def test_a_drift_over_a_run_of_images_is_noticed_before_it_costs_a_standard_deviation_of_a_pose(
    drift,
):
    """20 s in which a camera moves evenly; with the base watched. Recovered to a fiftieth."""
    sensor, frames = exact(), 1200
    ((name, size),) = drift.items()
    sensor.drift_rig(drift, frames)
    watch = sensor.watch_drift(base=True)
    for pose in path(sensor.home, frames):
        sensor.measure(pose)
    finding = watch.finding
    at = finding.noticed_frame
    lost = cost(sensor, at / (frames - 1) * rig_changes(drift), path(sensor.home, frames)[at])
    assert np.sqrt(np.mean(lost**2)) < 1.0, lost
    assert finding.movements[0].name == name
    assert finding.movements[0].amount == pytest.approx(size, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [{"camera.noise": False}, {"detection.detector": "grey_centroid"}, {"timing.exposure": 0.004}],
)
def test_images_give_no_alarm_for_what_is_no_drift(changes):
    """Rounding alone, a detector with a bias, stickers that smear; in motion and at rest."""
    sensor = exact(changes=changes)
    watch, poses = sensor.watch_drift(base=True), path(sensor.home, 36)
    rates = np.gradient(poses, 1.0 / RATE, axis=0)
    for share in (0.0, 1.0):
        sensor.start_run(3)
        for pose, rate in zip(poses, rates, strict=True):
            sensor.measure(sensor.home + share * (pose - sensor.home), pose_rate=share * rate)
        assert watch.finding.frames == 36
        assert watch.finding.noticed_s is None


def test_a_movement_that_explains_little_is_not_claimed():
    moved = Movement("left.k3", 0.05, 0.01)
    finding = Finding(1.0, 30, 20.0, 9.0, 1e-3, 600, 600, (moved,), 0.19, False, ())
    assert "moved" not in finding.warning
    assert "explains only 19 % of it" in finding.warning
    assert replace(finding, explained=0.95).warning.startswith("the cameras moved: noticed after")
