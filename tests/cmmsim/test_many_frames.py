"""Frames with images measured many at once, against the same frames looked at and measured one by
one.
"""

import numpy as np
import pytest

import cmmsim
from cmmsim import many_frames
from cmmsim.geometry.pose import invert, pose_to_transform
from tests.cmmsim.sensors import REACH, exact, poses_about_home

MEASURED = (
    "pose",
    "covariance",
    "points",
    "point_covariances",
    "left_pixels",
    "right_pixels",
    "pixel_variances",
)
FRAMES = 70  # more than two blocks
PATTERNED = {"camera.prnu": 0.01, "camera.dsnu": 8.0, "camera.bit_depth": 10, "camera.gain": 0.52}
SENSORS = {
    "sharp": lambda: exact(seed=3),
    "lenses": lambda: exact("all", PATTERNED, seed=3),
    "planes": lambda: exact(seed=3, method="planes"),
    "centroids": lambda: exact(changes={"detection.detector": "grey_centroid"}, seed=3),
}


def expected(sensor, pose):
    return invert(sensor.taught.base_from_camera) @ pose_to_transform(pose)


def one_by_one(sensor, poses, near, obstacles=None):
    """Measurements, or why there is none."""
    found = []
    for pose, around in zip(poses, near, strict=True):
        try:
            found.append(
                sensor.estimator.measure(sensor.look(pose, obstacles), expected(sensor, around))[0]
            )
        except cmmsim.LostError as error:
            found.append(str(error))
    return found


@pytest.mark.parametrize(
    "kind", ["sharp", pytest.param("lenses", marks=pytest.mark.slow), "planes", "centroids"]
)
def test_each_is_measured_as_alone(kind):
    """Behind an obstacle that hides some stickers in part, too, and where the platform is out of
    sight.
    """
    sensor = SENSORS[kind]()
    sensor.add_bodies({"rod": cmmsim.rod(0.3, 0.004)})
    before = sensor.home[:3] + np.array([0.25, 0.0, 0.25])
    aside = np.array([0.0, 0.15, 0.0])
    rod = {"rod": cmmsim.rod_transform(before - aside, before + aside)}
    count = FRAMES if kind == "sharp" else 6
    poses = poses_about_home(sensor, count)
    poses[2, 0] += 5.0
    near = poses + 0.01 * REACH * np.random.default_rng(1).uniform(-1, 1, poses.shape)
    plain = one_by_one(sensor, poses, near, rod)
    sensor.start_run(3)
    many = sensor.measure_many(poses, obstacles=rod, near=near)
    lost = [isinstance(one, str) for one in plain]
    assert lost == [k == 2 for k in range(count)]
    assert np.array_equal(np.isnan(many.poses[:, 0]), lost)
    assert many.stickers.tolist() == [
        0 if isinstance(one, str) else len(one.target_ids) for one in plain
    ]
    assert many.stickers[~np.array(lost)].min() < len(sensor.platform.sticker_ids)
    good = [one for one in plain if not isinstance(one, str)]
    np.testing.assert_allclose(many.poses[~np.array(lost)], [one.pose for one in good], atol=1e-12)
    np.testing.assert_allclose(
        many.covariances[~np.array(lost)], [one.covariance for one in good], rtol=1e-6
    )


@pytest.mark.parametrize("renderer", ["analytic", "statistical"])
def test_all_of_a_measurement_is_that_of_a_frame_alone(renderer):
    sensor = exact(seed=4, renderer=renderer)
    poses = poses_about_home(sensor, 8)
    poses[3, 0] += 5.0
    plain = one_by_one(sensor, poses, poses)
    sensor.start_run(4)
    for one, other in zip(sensor.measure_each(poses, poses), plain, strict=True):
        if isinstance(other, str):
            assert (one.ok, one.reason) == (False, other)
            continue
        for name in ("target_ids", "ok", "reason"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        for name in (*MEASURED, "common_covariance"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=1e-6, atol=1e-11
            )


def test_nothing_depends_on_the_number_of_threads(monkeypatch):
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(many_frames, "threads_at_most", lambda threads=threads: threads)
        sensor = exact(changes={"timing.dropout": 0.2}, seed=5)
        found.append(sensor.measure_many(poses_about_home(sensor, 100)))
        assert 10 <= np.isnan(found[-1].poses[:, 0]).sum() <= 30
    for other in found[1:]:
        for name, value in vars(found[0]).items():
            np.testing.assert_array_equal(value, getattr(other, name))


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["perfect", pytest.param("all", marks=pytest.mark.slow), "centroids"]
)
def test_each_in_motion_is_measured_as_alone(kind):
    """Streaks of up to two pixels beside ones that are too long to be told and frames at rest,
    behind an obstacle, with one out of sight; the right camera exposes later."""
    centroids = kind == "centroids"
    changes = {"timing.exposure": 0.002} | (
        {"detection.detector": "grey_centroid"} if centroids else {}
    )
    sensor = exact("perfect" if centroids else kind, changes, seed=3)
    sensor.move_rig({}, right_later=1e-5)
    sensor.add_bodies({"rod": cmmsim.rod(0.3, 0.004)})
    before, aside = sensor.home[:3] + np.array([0.25, 0.0, 0.25]), np.array([0.0, 0.15, 0.0])
    rod = {"rod": cmmsim.rod_transform(before - aside, before + aside)}
    count = FRAMES if kind == "perfect" else 7
    poses, rng = poses_about_home(sensor, count), np.random.default_rng(2)
    rates = (
        rng.uniform(-1, 1, (count, 6))
        * [0.3, 0.3, 0.3, 1.0, 1.0, 1.0]
        * (np.arange(count) % 3 > 0)[:, None]
    )
    rates[1], poses[2, 0] = np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0]), poses[2, 0] + 5.0
    near = poses + 0.01 * REACH * rng.uniform(-1, 1, poses.shape)
    plain = []
    for pose, rate, around in zip(poses, rates, near, strict=True):
        moved = expected(sensor, around) @ invert(pose_to_transform(pose))
        exposure_ends, frame_ends = (
            tuple(moved @ pose_to_transform(pose + half * rate) for half in (-end, end))
            for end in (0.001, 0.5 / sensor.timing.frame_rate)
        )
        images = sensor.look(pose, rod, pose_rate=rate)
        try:
            plain.append(
                sensor.estimator.measure(
                    images, expected(sensor, around), exposure_ends, frame_ends
                )[0]
            )
        except cmmsim.LostError:
            plain.append(None)
    sensor.start_run(3)
    many = sensor.measure_many(poses, rates, obstacles=rod, near=near)
    good = [k for k, one in enumerate(plain) if one is not None]
    assert count - 2 <= len(good) < count
    assert many.stickers.tolist() == [0 if one is None else len(one.target_ids) for one in plain]
    assert np.array_equal(np.flatnonzero(np.isfinite(many.poses[:, 0])), good)
    np.testing.assert_allclose(many.poses[good], [plain[k].pose for k in good], atol=1e-12)
    np.testing.assert_allclose(
        many.covariances[good], [plain[k].covariance for k in good], rtol=1e-6
    )


def test_what_moves_is_measured_as_it_moves():
    """Stickers are drawn out over half a pixel, of which the fit is told."""
    sensor = exact(changes={"timing.exposure": 1e-4}, seed=6)
    poses, rates = poses_about_home(sensor, 12), np.tile([4.0, 6.0, 0.0, 0.0, 0.0, 0.0], (12, 1))
    found = sensor.measure_many(poses, rates)
    errors = found.poses - poses
    squared = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(found.covariances), errors)
    assert 2.5 < squared.mean() < 11.0  # 6, by 72 degrees of freedom
    assert found.stickers.min() >= 14


@pytest.mark.parametrize("renderer", ["analytic", "statistical"])
def test_rows_of_numbers_are_asked_for_and_may_be_none(renderer):
    sensor = exact(renderer=renderer)
    two = [sensor.home] * 2
    with pytest.raises(cmmsim.ShapeError, match="near needs six finite numbers per pose"):
        sensor.measure_many(two, near=sensor.home)
    with pytest.raises(
        cmmsim.ShapeError, match="each pose needs a pose rate of six finite numbers"
    ):
        sensor.measure_many(two, two[0])
    for wrong in ([[1.0, 2.0], [1.0]], None, np.array(1.0)):
        with pytest.raises(cmmsim.ShapeError, match="each pose is a row of six finite numbers"):
            sensor.measure_many(wrong)
    for none in ([], np.zeros((0, 6))):
        empty = sensor.measure_many(none)
        assert (empty.poses.shape, empty.covariances.shape, empty.stickers.shape) == (
            (0, 6),
            (0, 6, 6),
            (0,),
        )
