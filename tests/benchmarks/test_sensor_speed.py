"""Rendering and measuring in the loop: frames a second, against a straightforward pipeline, and over many frames.

SENSOR_FRAMES=100000 in the environment makes the runs for memory that long.
"""

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import cmmsim
from cmmsim.imaging import pyrender_renderer as render
from tests.benchmarks.timing import WHOLE_SECOND_CORE, OtherLoad, judge, second_core_gain, slowness

pytestmark = [pytest.mark.slow, pytest.mark.rendering]
# Stereo frames a second on two free cores of the machine of timing.REFERENCE_SECONDS.
GOALS = {"analytic": 300.0, "pyrender": 60.0}
TIMES_STRAIGHTFORWARD = {"analytic": 20.0, "pyrender": 8.0}
BATCH, BATCHES, MOST_ROUNDS = 20, 30, 5
MEMORY_FRAMES = {"analytic": 3_000, "pyrender": 1_000}
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
    """Seconds a frame of the fastest batch; all frames are measured well."""
    fastest = np.inf
    for start in range(0, len(poses), BATCH):
        batch = poses[start : start + BATCH]
        began = time.perf_counter()
        found = [sensor.measure(pose) for pose in batch]
        fastest = min(fastest, (time.perf_counter() - began) / len(batch))
        # A good sticker contradicts the others once in some thousand by chance, and is left out.
        assert all(m.ok and len(m.target_ids) >= 17 for m in found)
    return fastest


def test_frames_a_second(sensor, record_property, quote):
    """The fastest batch counts, and the fastest of the machine's own work between the rounds: a virtual machine may be
    slow for some seconds without showing what else runs. Frames use both cores: a miss counts where both are whole.
    """
    poses, goal, rate, slower = path(sensor, BATCH * (BATCHES + 1)), GOALS[sensor.renderer], 0.0, np.inf
    gains = []
    for pose in poses[:BATCH]:
        sensor.measure(pose)
    with OtherLoad() as load:
        for _ in range(MOST_ROUNDS):
            rate = max(rate, 1.0 / frame_seconds(sensor, poses[BATCH:]))
            slower = min(slower, slowness())
            if rate * slower >= goal:
                break
            gains.append(second_core_gain())
    second = float(np.median(gains or [2.0]))
    part = f"the second core brings a loop {second:.2f} x" if second < WHOLE_SECOND_CORE else ""
    record_property("frames_per_second", round(rate, 1))
    judge(
        rate * slower >= goal,
        f"{rate:.1f} stereo frames a second with {sensor.renderer}, goal {goal:g} on one {slower:.2f} times as fast",
        load,
        part,
    )
    quote(**{f"{sensor.renderer}_frames_a_second": rate})


def test_against_a_straightforward_pipeline(sensor, record_property, quote):
    """Rounds alternate and the fastest of each counts. The other pipeline measures the same poses, only worse.

    20 times is the goal of the sensor and reached by the analytic renderer. Drawing finely with pyrender's meshes is
    bound by the software rasteriser: a frame takes a 22nd of the other's processor time, but less of it on both cores.
    """
    from tests.benchmarks.straightforward_sensor import StraightforwardSensor

    other = StraightforwardSensor(sensor)
    KEPT.append(other)
    poses = path(sensor, 6 * BATCH)
    ours, theirs, errors = np.inf, np.inf, []
    with OtherLoad() as load:
        for start in range(0, len(poses), BATCH):
            ours = min(ours, frame_seconds(sensor, poses[start : start + BATCH]))
            for pose in poses[start : start + 3]:
                began = time.perf_counter()
                found, count = other.measure(pose, pose)
                theirs = min(theirs, time.perf_counter() - began)
                assert count >= 12
                errors.append(found - pose)
    assert np.abs(errors)[:, :3].max() < 1e-3
    ratio = theirs / ours
    record_property("times_straightforward", round(ratio, 1))
    goal = TIMES_STRAIGHTFORWARD[sensor.renderer]
    judge(
        ratio >= goal,
        f"{ratio:.1f} times a straightforward pipeline ({1e3 * theirs:.0f} ms a frame) with "
        f"{sensor.renderer}, goal {goal:g}",
        load,
    )
    quote(**{f"{sensor.renderer}_times_straightforward": ratio})


def test_memory_and_renderer_stay_over_many_frames(sensor, monkeypatch):
    """Memory in use after all frames is that after the first tenth, and nothing of OpenGL is made anew."""
    frames = int(os.environ.get("SENSOR_FRAMES", MEMORY_FRAMES[sensor.renderer]))
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


def resident_bytes():
    """Memory in use now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_kernels_compile_within_fifteen_seconds(tmp_path, taught, record_property):
    """Of processor time, into an empty cache, tried once more where it is missed; another process loads them in a small
    part of it."""
    code = (
        "import time, numpy as np, cmmsim; s = cmmsim.load_sensor('ctrack780', renderer='analytic');"
        "from cmmsim import teaching; c = time.process_time(); s.look(s.home).windows(np.full((2, 3, 2), 700), 16);"
        "from cmmsim.detection.ellipse_fit import fit_ellipses; from cmmsim.geometry.stereo_rig import triangulate;"
        "from cmmsim.geometry.registration import register;"
        "fit_ellipses(np.zeros((1, 16, 16)), np.zeros((1, 2), int), s.noise, 14);"
        "p = np.full((4, 2), 1000.0); e = np.tile(np.eye(2), (4, 1, 1)); triangulate(s.rig, p, p, e, e);"
        "x = np.eye(3); register(x, x, np.tile(np.eye(3), (3, 1, 1))); print(time.process_time() - c)"
    )

    def spent(cache):
        return float(
            subprocess.run(
                [sys.executable, "-c", code],
                check=True,
                capture_output=True,
                text=True,
                env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / cache)},
            ).stdout
        )

    with OtherLoad() as load:
        goal, cold, warm = 15.0 * slowness(), spent("first"), spent("first")
        if cold > goal:
            cold = min(cold, spent("second"))
    record_property("compile_seconds", round(cold, 1))
    assert warm < 0.3 * cold
    judge(cold <= goal, f"kernels took {cold:.1f} s to compile, goal {goal:.1f}", load)
