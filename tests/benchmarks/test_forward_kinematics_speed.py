"""The paper's argument for the sensor: forward kinematics is slow, a pose from matched pixels is not. Timed here."""

import time

import numpy as np
import pytest

import cmmsim
import dynamics
from cmmsim.geometry.pose import compose_covariance, pose_covariance, pose_to_transform, transform_to_pose
from cmmsim.geometry.stereo_rig import triangulate
from cmmsim.pose_estimation.estimator import METHODS, by_planes, by_registration
from cmmsim.pose_estimation.observation import StickerObservation
from dynamics import compilation

pytestmark = [pytest.mark.slow, pytest.mark.rendering]
POSES = 1000


@pytest.fixture(scope="module")
def robot():
    return dynamics.load_robot("rss6")


@pytest.fixture(scope="module")
def angles(robot):
    """Crank angles of poses in the box of the experiments, (POSES, 6)."""
    box = np.array([0.01, 0.01, 0.01, 0.04, 0.04, 0.04])
    return robot.inverse_kinematics(robot.home_pose + box * np.random.default_rng(0).uniform(-1, 1, (POSES, 6)))


def seconds(function, count):
    """Best of five mean times of a call."""
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(count):
            function()
        best = min(best, (time.perf_counter() - start) / count)
    return best


@pytest.fixture(scope="module")
def vision():
    """(method) -> a function that turns the matched pixels of one rendered frame into a pose and its covariance."""
    sensor = cmmsim.load_sensor("ctrack780", seed=0)
    seen = sensor.measure(sensor.home)
    estimator = sensor.estimator
    index = np.flatnonzero(np.isin(estimator.platform.sticker_ids, seen.target_ids))
    np.testing.assert_array_equal(estimator.platform.sticker_ids[index], seen.target_ids)
    spread = np.broadcast_to(0.01**2 * np.eye(2), (len(index), 2, 2))
    camera_from_platform = np.linalg.inv(estimator.taught.base_from_camera) @ pose_to_transform(seen.pose)
    towards = estimator.platform.normals @ camera_from_platform[:3, :3].T

    def from_pixels(method):
        stereo = triangulate(estimator.rig, seen.left_pixels, seen.right_pixels, spread, spread)
        observed = StickerObservation(index, seen.left_pixels, seen.right_pixels, stereo.points, stereo.covariances)
        if method == "planes":
            transform, covariance, _ = by_planes(observed, estimator.platform, towards)
        else:
            transform, covariance, _ = by_registration(observed, estimator.taught.platform_places)
        base_from_platform = estimator.taught.base_from_camera @ transform
        spread_6 = compose_covariance(estimator.taught.base_from_camera, covariance)
        return transform_to_pose(base_from_platform), pose_covariance(base_from_platform, spread_6)

    np.testing.assert_allclose(from_pixels("registration")[0], seen.pose, atol=2e-4)
    return from_pixels


def test_forward_kinematics_of_a_batch_against_single_poses(benchmark, robot, angles):
    """A batch shares the overhead of Python: at least five times faster a pose than one by one."""
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    single = seconds(lambda: robot.forward_kinematics(angles[0]), 100)
    benchmark.pedantic(robot.forward_kinematics, args=(angles,), rounds=5, warmup_rounds=1)
    batch = seconds(lambda: robot.forward_kinematics(angles), 1) / POSES
    benchmark.extra_info.update(single_us=round(1e6 * single, 1), batch_us=round(1e6 * batch, 1))
    assert single > 5 * batch


@pytest.mark.parametrize("method", METHODS)
def test_forward_kinematics_against_the_pose_from_matched_pixels(benchmark, robot, angles, vision, method, capsys):
    """Both are timed side by side and printed, whoever wins; asserted is only that both are below 10 ms, so that
    neither stands in the way of a 60 Hz loop."""
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    single = seconds(lambda: robot.forward_kinematics(angles[0]), 100)
    batch = seconds(lambda: robot.forward_kinematics(angles), 1) / POSES
    benchmark.pedantic(vision, args=(method,), rounds=5, iterations=50, warmup_rounds=1)
    sight = seconds(lambda: vision(method), 100)
    benchmark.extra_info.update(forward_kinematics_over_vision=round(single / sight, 2))
    with capsys.disabled():
        print(  # noqa: T201
            f"\nforward kinematics {1e6 * single:.0f} us alone, {1e6 * batch:.0f} us a pose in a batch of {POSES}; "
            f"pose from matched pixels ({method}, with covariance) {1e6 * sight:.0f} us: "
            f"{single / sight:.2f} and {batch / sight:.3f} of it"
        )
    assert max(single, sight) < 0.01
