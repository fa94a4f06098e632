"""Rendering and measuring in the loop: frames a second, against a straightforward pipeline, and over many frames."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

import cmmsim
import dynamics
from cmmsim.geometry.pose import compose_covariance, pose_covariance, pose_to_transform, transform_to_pose
from cmmsim.geometry.stereo_rig import triangulate
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.pose_estimation.estimator import METHODS, by_planes, by_registration
from cmmsim.pose_estimation.observation import StickerObservation
from tests.benchmarks.timing import OtherLoad, fastest, judge, resident_bytes

pytestmark = [pytest.mark.thorough, pytest.mark.rendering]
TIMES_STRAIGHTFORWARD = {"analytic": 20.0, "pyrender": 8.0}
BATCH = 20
MEMORY_FRAMES = {"analytic": 100_000, "pyrender": 20_000}
KEPT = []  # what must live as long as OpenGL is used
LARGEST_GROWTH = 4e6  # bytes; one renderer made anew takes 2 MB


@pytest.fixture(scope="module")
def taught():
    return cmmsim.load_sensor("ctrack780", seed=0).taught


@pytest.fixture(params=["analytic", "pyrender"])
def sensor(request, taught):
    return cmmsim.load_sensor("ctrack780", seed=0, taught=taught, renderer=request.param)


def path(sensor, count):
    """Poses (count, 6) at 60 Hz inside the travel of the platform."""
    t = np.arange(count)[:, None] / 60.0
    angle = 2.0 * np.pi * np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.3]) * t + np.arange(6)
    return sensor.home + np.array([0.009] * 3 + [0.035] * 3) * np.sin(angle)


def frame_seconds(sensor, poses):
    """Seconds a frame of a batch whose frames are all measured well."""
    began = time.perf_counter()
    found = [sensor.measure(pose) for pose in poses]
    spent = (time.perf_counter() - began) / len(poses)
    # A good sticker contradicts the others once in some thousand by chance, and is left out.
    assert all(m.ok and len(m.target_ids) >= 17 for m in found)
    return spent


def test_against_a_straightforward_pipeline(sensor, quote):
    """Rounds alternate and the fastest of each counts. The other pipeline measures the same poses, only worse.

    20 times is the goal of the sensor and reached by the analytic renderer. Drawing finely with pyrender's meshes is
    bound by the software rasteriser: a frame takes a 22nd of the other's processor time, but less of it on both cores.
    """
    from tests.benchmarks.straightforward_sensor import StraightforwardSensor

    other = StraightforwardSensor(sensor)
    KEPT.append(other)
    poses = path(sensor, 20 * BATCH)
    frame_seconds(sensor, poses[:BATCH])
    ours, theirs, errors = np.inf, np.inf, []
    with OtherLoad() as load:
        for start in range(BATCH, len(poses), BATCH):
            ours = min(ours, frame_seconds(sensor, poses[start : start + BATCH]))
            for pose in poses[start : start + 3]:
                began = time.perf_counter()
                found, count = other.measure(pose, pose)
                theirs = min(theirs, time.perf_counter() - began)
                assert count >= 12
                errors.append(found - pose)
    assert np.abs(errors)[:, :3].max() < 1e-3
    ratio, goal = theirs / ours, TIMES_STRAIGHTFORWARD[sensor.renderer]
    figure = f"{ratio:.1f} times a straightforward pipeline ({1e3 * theirs:.0f} ms a frame) with {sensor.renderer}"
    judge(ratio >= goal, f"{figure}, goal {goal:g}", load)
    quote(**{f"{sensor.renderer}_times_straightforward": ratio, f"{sensor.renderer}_frames_a_second": 1.0 / ours})


def test_memory_and_renderer_stay_over_many_frames(sensor, monkeypatch):
    """Memory in use after all frames is that after the first tenth, and nothing of OpenGL is made anew."""
    frames = MEMORY_FRAMES[sensor.renderer]
    made = count_renderers(monkeypatch) if sensor.renderer == "pyrender" else []
    poses = path(sensor, 600)
    for n in range(frames):
        if n == frames // 10:
            made.clear()
            before = resident_bytes()
        assert sensor.measure(poses[n % len(poses)]).ok
    growth = resident_bytes() - before
    assert growth < LARGEST_GROWTH, f"{growth / 1e6:.1f} MB in {frames} frames"
    assert made == []
    if sensor.renderer == "pyrender":
        assert render._shared_atlas.cache_info().misses == 1


def count_renderers(monkeypatch):
    """A list that gets the name of each renderer or frame buffer that is made."""
    import pyrender
    from pyrender.renderer import Renderer

    made = []
    for kind in (pyrender.OffscreenRenderer, Renderer, render._FrameBuffer):

        def counted(self, *args, _kind=kind, _plain=kind.__init__, **kwargs):
            made.append(_kind.__name__)
            _plain(self, *args, **kwargs)

        monkeypatch.setattr(kind, "__init__", counted)
    return made


def test_kernels_compile_only_once(tmp_path, taught, record_property):
    """Processor time into an empty cache; another process loads them in a small part of it."""
    code = (
        "import time, numpy as np, cmmsim; s = cmmsim.load_sensor('ctrack780', renderer='analytic');"
        "from cmmsim import teaching; c = time.process_time(); s.look(s.home).windows(np.full((2, 3, 2), 700), 16);"
        "from cmmsim.detection.ellipse_fit import fit_ellipses; from cmmsim.geometry.stereo_rig import triangulate;"
        "from cmmsim.geometry.registration import register;"
        "fit_ellipses(np.zeros((1, 16, 16)), np.zeros((1, 2), int), s.noise, 14);"
        "p = np.full((4, 2), 1000.0); e = np.tile(np.eye(2), (4, 1, 1)); triangulate(s.rig, p, p, e, e);"
        "x = np.eye(3); register(x, x, np.tile(np.eye(3), (3, 1, 1))); print(time.process_time() - c)"
    )

    def spent():
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        return float(subprocess.check_output([sys.executable, "-c", code], env=environment))

    cold, warm = spent(), spent()
    record_property("compile_seconds", round(cold, 1))
    assert warm < 0.3 * cold


@pytest.fixture(scope="module")
def vision(taught):
    """(method) -> a function that turns the matched pixels of one rendered frame into a pose and its covariance."""
    sensor = cmmsim.load_sensor("ctrack780", seed=0, taught=taught)
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


@pytest.mark.parametrize("method", METHODS)
def test_forward_kinematics_beside_the_pose_from_matched_pixels(vision, method, record_property):
    """The paper's argument for the sensor is that forward kinematics is slow. Both are recorded, whoever wins."""
    robot = dynamics.load_robot("rss6")
    angles = robot.inverse_kinematics(robot.home_pose + 0.005)
    rounds = {
        "forward_kinematics_us": lambda: [robot.forward_kinematics(angles) for _ in range(100)],
        "vision_us": lambda: [vision(method) for _ in range(100)],
    }
    for name, best in fastest(rounds, 5).items():
        record_property(name, 1e4 * best)
