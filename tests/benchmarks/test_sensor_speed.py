"""Rendering and measuring in the loop: frames a second, against a straightforward pipeline, and
over many frames.
"""

import os
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

import cmmsim
from cmmsim.geometry.pose import apply, pose_to_transform, transform_to_pose
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.imaging.pyrender_meshes import disc_mesh
from tests.benchmarks.timing import OtherLoad, judge, plain_work, resident_bytes, seconds
from tests.cmmsim.plain import rigid_start

pytestmark = [pytest.mark.thorough, pytest.mark.rendering]
TIMES_STRAIGHTFORWARD = {"analytic": 20.0, "pyrender": 8.0}
BATCH = 20
# renderer, frames, and how many of them a piece of `plain_work` of 24 ms should see at least
GOALS = {
    "without images": ("statistical", 40_000, 2400.0),  # 100,000 a second
    "images together": ("analytic", 1000, 36.0),  # 1,500 a second
    "images in the loop": ("pyrender", 5 * BATCH, 2.4),  # 100 a second
}
TIMES_ONE_BY_ONE = 3.0  # of frames with images measured many at once, on two cores
MEMORY_FRAMES = {"analytic": 100_000, "pyrender": 20_000}
KEPT = []  # what must live as long as OpenGL is used
LARGEST_GROWTH = 4e6  # bytes; one renderer made anew takes 2 MB
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
NEAREST_PX = 6.0
SAMPLE = 1e-4  # m: as finely as stickers are triangulated


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


@pytest.mark.parametrize("kind", GOALS)
def test_frames_during_a_piece_of_plain_work(taught, kind, record_property):
    """On all cores where poses are known beforehand, and frame after frame in the loop; rounds
    alternate.
    """
    renderer, count, goal = GOALS[kind]
    sensor, together = (
        cmmsim.load_sensor("ctrack780", taught=taught, renderer=renderer),
        count > 5 * BATCH,
    )
    # without a jump, after which stickers have to be searched
    rounds = path(sensor, 9 * count).reshape(9, count, 6)
    sensor.measure_many(rounds[0, : 5 * BATCH]) if together else frame_seconds(sensor, rounds[0])
    piece, frame, processor = np.inf, np.inf, np.inf
    with OtherLoad() as load:
        for poses in rounds[1:]:
            piece = min(piece, seconds(plain_work))
            began, used = time.perf_counter(), time.process_time()
            found = (
                sensor.measure_many(poses).stickers if together else frame_seconds(sensor, poses)
            )
            frame = min(frame, (time.perf_counter() - began) / count)
            processor = min(processor, (time.process_time() - used) / count)
            assert np.min(found) >= 14 or not together
    name = kind.replace(" ", "_")
    record_property(f"{name}_frames_a_second", 1.0 / frame)
    record_property(f"{name}_frames_a_processor_second", 1.0 / processor)
    record_property(f"{name}_frames_a_piece", piece / frame)
    judge(
        piece / frame >= goal,
        f"{piece / frame:.3g} frames during {1e3 * piece:.0f} ms, goal {goal:g}",
        load,
    )


def test_images_many_at_once_against_one_by_one(taught, record_property):
    """The same frames at rest, in rounds that alternate; on two cores."""
    sensor = cmmsim.load_sensor("ctrack780", seed=0, taught=taught, renderer="analytic")
    few, many = path(sensor, 5 * BATCH), path(sensor, 1000)
    frame_seconds(sensor, few[:BATCH])
    sensor.measure_many(many[: 5 * BATCH])
    alone, together = np.inf, np.inf
    with OtherLoad() as load:
        for start in range(0, len(few), BATCH):
            alone = min(alone, frame_seconds(sensor, few[start : start + BATCH]))
            began = time.perf_counter()
            found = sensor.measure_many(many)
            together = min(together, (time.perf_counter() - began) / len(many))
    assert found.stickers.min() >= 17
    record_property("analytic_times_one_by_one", alone / together)
    judge(
        alone / together >= TIMES_ONE_BY_ONE,
        f"{alone / together:.1f} times, goal {TIMES_ONE_BY_ONE:g}",
        load,
    )


def test_against_a_straightforward_pipeline(sensor, record_property):
    """Rounds alternate and the fastest of each counts. The other pipeline measures the same poses,
    only worse.

    20 times is the goal of the sensor and reached by the analytic renderer. Drawing finely with
    pyrender's meshes is bound by the software rasteriser: a frame takes a 22nd of the other's
    processor time, but less of it on both cores.
    """
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
                found, count = other.measure(pose)
                theirs = min(theirs, time.perf_counter() - began)
                assert count >= 12
                errors.append(found - pose)
    assert np.abs(errors)[:, :3].max() < 1e-3
    ratio, goal = theirs / ours, TIMES_STRAIGHTFORWARD[sensor.renderer]
    figure = (
        f"{ratio:.1f} times a straightforward pipeline ({1e3 * theirs:.0f} ms a frame) with "
        f"{sensor.renderer}"
    )
    record_property(f"{sensor.renderer}_times_straightforward", ratio)
    record_property(f"{sensor.renderer}_frames_a_second", 1.0 / ours)
    judge(ratio >= goal, f"{figure}, goal {goal:g}", load)


def test_memory_and_renderer_stay_over_many_frames(sensor, monkeypatch):
    """Memory in use after all frames is that after the first tenth, and nothing of OpenGL is made
    anew.
    """
    import pyrender
    from pyrender.renderer import Renderer

    frames, poses = MEMORY_FRAMES[sensor.renderer], path(sensor, 600)
    for n in range(frames):
        if n == frames // 10:
            for kind in (pyrender.OffscreenRenderer, Renderer, render._FrameBuffer):
                monkeypatch.setattr(kind, "__init__", None)  # who makes another fails
            before = resident_bytes()
        assert sensor.measure(poses[n % len(poses)]).ok
    growth = resident_bytes() - before
    assert growth < LARGEST_GROWTH, f"{growth / 1e6:.1f} MB in {frames} frames"
    if sensor.renderer == "pyrender":
        assert render._shared_atlas.cache_info().misses == 1


def test_kernels_compile_only_once(tmp_path, record_property):
    """Processor time of a first measurement with an empty cache; another process needs a small part
    of it.
    """
    code = (
        "import time, cmmsim; sensor = cmmsim.load_sensor('ctrack780', seed=0, "
        "renderer='analytic');"
        "began = time.process_time(); sensor.measure(sensor.home); print(time.process_time() - "
        "began)"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    cold, warm = (
        float(subprocess.check_output([sys.executable, "-c", code], env=environment))
        for _ in range(2)
    )
    record_property("compile_seconds", round(cold, 1))
    assert warm < 0.3 * cold


class StraightforwardSensor:
    """What one writes first: whole images by pyrender, OpenCV's blob detector, nearest blobs,
    triangulatePoints, a fit.

    Draws and measures the scene of a ``cmmsim.Sensor`` whose lenses are perfect.

    Keep it as long as the process draws: pyrender closes the display for all when an
    OffscreenRenderer goes.
    """

    def __init__(self, sensor):
        import pyrender

        self._sensor, self._rig = sensor, sensor.rig
        self._renderer = pyrender.OffscreenRenderer(self._rig.left.width, self._rig.left.height)
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 1.0))
        self._bodies = [
            self._scene.add(pyrender.Mesh([self._primitive(body)]))
            for body in sensor.true_cameras.scene
        ]
        c = self._rig.left
        camera = pyrender.IntrinsicsCamera(
            c.focal_px, c.focal_px * c.aspect, c.centre_x_px + 0.5, c.centre_y_px + 0.5, 0.2, 10.0
        )
        self._camera = self._scene.add(camera)
        settings = cv2.SimpleBlobDetector_Params()
        settings.blobColor, settings.filterByArea, settings.minArea, settings.maxArea = (
            255,
            True,
            10.0,
            400.0,
        )
        self._detector = cv2.SimpleBlobDetector_create(settings)

    def measure(self, pose):
        """Pose (6,) measured of the platform that stands at ``pose``, which also says which blob is
        which.
        """
        base_from_platform, taught = pose_to_transform(pose), self._sensor.taught
        self._scene.set_pose(self._bodies[0], base_from_platform)
        places, camera_from_base = taught.platform_places, np.linalg.inv(taught.base_from_camera)
        expected, _ = self._rig.project(apply(camera_from_base @ base_from_platform, places))
        found = [
            self._nearest(self._blobs(move), at)
            for move, at in zip(self._rig.from_camera, expected, strict=True)
        ]
        seen = np.flatnonzero(np.isfinite(found[0][:, 0]) & np.isfinite(found[1][:, 0]))
        first, second = self._rig.projection_matrices
        points = cv2.triangulatePoints(first, second, found[0][seen].T, found[1][seen].T)
        camera_from_platform = rigid_start(places[seen], (points[:3] / points[3]).T)
        return transform_to_pose(taught.base_from_camera @ camera_from_platform), len(seen)

    def _blobs(self, move):
        from pyrender import RenderFlags

        camera_from_base = move @ self._sensor.true_cameras.camera_from_base
        self._scene.set_pose(self._camera, np.linalg.inv(OPENGL_FROM_OPENCV @ camera_from_base))
        colour, _ = self._renderer.render(self._scene, RenderFlags.FLAT)
        grey = np.ascontiguousarray(colour[:, :, 0])
        return np.array([blob.pt for blob in self._detector.detect(grey)]).reshape(-1, 2)

    @staticmethod
    def _nearest(blobs, expected):
        """The blob (n,2) next to each expected pixel (n,2), NaN where none is near."""
        result = np.full(expected.shape, np.nan)
        gaps = np.linalg.norm(expected[:, None] - blobs[None], axis=2)
        near = np.flatnonzero(gaps.min(axis=1, initial=np.inf) < NEAREST_PX)
        result[near] = blobs[gaps[near].argmin(axis=1)]
        return result

    @staticmethod
    def _primitive(body):
        """Solid and stickers of a body as one mesh."""
        from pyrender import MetallicRoughnessMaterial, Primitive

        patches = [body.solid, *(disc_mesh(sticker, SAMPLE) for sticker in body.stickers)]
        starts = np.cumsum([0, *(len(p.vertices) for p in patches)])
        grey = np.repeat(np.concatenate([p.levels for p in patches])[:, None], 3, axis=1)
        return Primitive(
            positions=np.concatenate([p.vertices for p in patches]).astype(np.float32),
            indices=np.concatenate(
                [p.faces + s for p, s in zip(patches, starts, strict=False)]
            ).astype(np.uint32),
            color_0=np.column_stack([grey, np.ones(len(grey))]).astype(np.float32),
            mode=4,
            material=MetallicRoughnessMaterial(
                baseColorFactor=(1.0, 1.0, 1.0, 1.0), doubleSided=True
            ),
        )
