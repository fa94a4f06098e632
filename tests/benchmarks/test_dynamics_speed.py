"""Speed of the closed loop as ratios: to real time, and of sensitivities to the plain run. Needs a C compiler."""

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import dynamics
from dynamics import closed_loop, compilation
from dynamics.batch import simulate_batch

pytestmark = pytest.mark.slow
SECONDS, RATE = 20.0, 60.0


@pytest.fixture(scope="module")
def loop():
    """(sensitivities) -> one run of 20 s at 60 Hz with 4 steps a frame, exact friction, parameters of Table 2."""
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    robot = dynamics.load_robot("rss6")
    parameters = robot.parameter_sets["identified"].vector
    t = np.arange(round(SECONDS * RATE))[:, None] / RATE
    amplitude, frequency = np.array([6e-3, 5e-3, 4e-3, 0.02, 0.015, 0.02]), 2 * np.pi * np.linspace(0.3, 0.8, 6)
    envelope, slope = 1 - np.exp(-(t**3)), 3 * t**2 * np.exp(-(t**3))
    wave, rate = np.sin(frequency * t), frequency * np.cos(frequency * t)
    reference = closed_loop.Reference(
        robot.home_pose + amplitude * envelope * wave, amplitude * (envelope * rate + slope * wave)
    )
    settings = closed_loop.LoopSettings(closed_loop.ServoGains(0.3, 0.001, 2.4), closed_loop.FrameTiming(RATE))

    def run(sensitivities=False, frames=None):
        part = closed_loop.Reference(reference.poses[:frames], reference.rates[:frames])
        return closed_loop.simulate(robot, parameters, part, settings, sensitivities=sensitivities, compiled=True)

    run.parts = (robot, parameters, reference, settings)
    run()
    return run


def _best(function, repeats):
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def test_closed_loop_against_real_time(benchmark, loop):
    """Goal 300 times real time on one idle core; asserted at 100, so that a busy machine does not fail it."""
    benchmark.pedantic(loop, rounds=10, warmup_rounds=1)
    ratio = SECONDS / (benchmark.stats.stats.min if benchmark.stats else _best(loop, 5))
    benchmark.extra_info["times_real_time"] = round(ratio)
    assert ratio >= 100


def test_sensitivities_against_the_plain_run(benchmark, loop):
    """All 67 sensitivities of a run cost at most 15 plain runs (finite differences would cost 67 or more)."""
    benchmark.pedantic(loop, args=(True,), rounds=3, warmup_rounds=1)
    own = benchmark.stats.stats.min if benchmark.stats else _best(lambda: loop(True), 3)
    ratio = own / _best(loop, 10)
    benchmark.extra_info["plain_runs"] = round(ratio, 1)
    assert ratio <= 15


def test_a_batch_uses_all_cores(benchmark, loop):
    """Goal on two idle cores: 1.8 times one core; asserted at 1.2, and not at all where others take a core."""
    if (os.cpu_count() or 1) < 2:
        pytest.skip("needs two cores")
    busy = os.getloadavg()[0] > 0.6 * (os.cpu_count() or 1)
    robot, parameters, reference, settings = loop.parts

    def batch(workers):
        return simulate_batch(robot, np.tile(parameters, (24, 1)), reference, settings, workers=workers)

    ratios = []
    for _ in range(5):
        one, two = _best(lambda: batch(1), 1), _best(lambda: batch(2), 1)
        ratios.append(one / two)
    benchmark.extra_info["times_one_core"] = round(float(np.median(ratios)), 2)
    benchmark.pedantic(batch, args=(2,), rounds=2)
    assert busy or max(ratios) >= 1.2


def test_everything_compiles_within_twenty_seconds_and_only_once(benchmark, tmp_path, monkeypatch):
    """Both libraries into an empty cache; a second process finds them and compiles nothing."""
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path))
    command = [sys.executable, "-c", "import dynamics as d; r = d.load_robot('rss6'); r.functions;"
               " d.closed_loop.prepare(r)"]
    first = _best(lambda: subprocess.run(command, check=True), 1)
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    benchmark.pedantic(subprocess.run, args=(command,), kwargs={"check": True}, rounds=1)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == stamps
    assert len(stamps) == 2
    benchmark.extra_info["first_use_s"] = round(first, 1)
    assert first <= 20 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def test_memory_does_not_grow_over_ten_thousand_runs(loop):
    """Memory in use after 10,000 runs of three frames is that after the first thousand, within 4 MB."""
    for n in range(10_000):
        loop(sensitivities=n % 10 == 0, frames=3)
        if n == 1000:
            before = _resident_bytes()
    assert _resident_bytes() - before < 4e6


def _resident_bytes():
    """Memory in use now; the peak of the process would hide growth below what earlier tests took."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
