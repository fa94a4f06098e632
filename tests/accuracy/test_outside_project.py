"""A project outside this one, in an environment of its own with the distribution installed from a wheel."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.rendering]

ROOT = Path(__file__).parents[2]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "cmmsim_command.py", "cmmsim", "dynamics", "identify")
PROJECT = """
import cmmsim
import numpy as np
import pytest


def test_installed(request):
    assert request.config.rootpath.as_posix() in cmmsim.__file__


@pytest.mark.parametrize("method", ["planes", "registration"])
def test_pose(accuracy, cmmsim_sensor, cmmsim_seed, method):
    cmmsim_sensor.method = method
    poses = cmmsim_sensor.home + 0.003 * np.random.default_rng(cmmsim_seed).uniform(-1, 1, (8, 6))
    errors = [1e6 * np.linalg.norm((cmmsim_sensor.measure(pose).pose - pose)[:3]) for pose in poses]
    accuracy.sample("position error", errors, unit="um", limit=50)


@pytest.mark.cmmsim(scenario="mine.toml")
def test_dynamics(accuracy, cmmsim_robot, cmmsim_scenario):
    assert cmmsim_scenario.name == "mine"
    pose, motion = cmmsim_robot.home_pose, np.array([0.1, 0.0, 0.2, 0.3, -0.2, 0.1])
    torque = cmmsim_robot.inverse_dynamics(pose, motion, motion)
    error = np.abs(cmmsim_robot.forward_dynamics(pose, motion, torque) - motion).max()
    accuracy.record("forward after inverse dynamics", error, unit="m/s2", limit=1e-9)
"""


def run(*command, cwd):
    """Outcome of a command that knows nothing of this checkout."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTEST_ADDOPTS")}
    return subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, env=environment, check=False
    )


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """A folder with an environment `venv`: the wheel in it, the packages it depends on beside this interpreter's."""
    folder = tmp_path_factory.mktemp("outside")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        whole = ROOT / name
        copy = shutil.copytree if whole.is_dir() else shutil.copy
        copy(whole, source / name, **({"ignore": shutil.ignore_patterns("__pycache__")} if whole.is_dir() else {}))
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    built = run(*pip, "wheel", "--no-deps", "--wheel-dir", folder, source, cwd=folder)
    if "Could not find a version that satisfies the requirement setuptools" in built.stderr:
        pytest.skip("no package index to take the build's setuptools from")
    assert built.returncode == 0, built.stderr
    wheel = next(folder.glob("*.whl"))
    python = folder / "venv" / "bin" / "python"
    assert run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder).returncode == 0
    installed = run(*pip, "--python", python, "install", "--no-deps", wheel, cwd=folder)
    assert installed.returncode == 0, installed.stderr
    packages = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).stdout.strip()
    (Path(packages) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    shutil.rmtree(source)
    (folder / "test_mine.py").write_text(PROJECT)
    shutil.copy(ROOT / "tests" / "accuracy" / "guide" / "test_own_pose_estimator.py", folder)
    (folder / "mine.toml").write_text('name = "mine"\n')
    return folder


def test_its_tests_find_the_fixtures_and_save_their_figures(outside):
    done = run("venv/bin/python", "-m", "pytest", "--strict-markers", "--accuracy-save", "first", cwd=outside)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 passed" in done.stdout
    figures = json.loads((outside / ".accuracy" / "first.json").read_text())["figures"]
    mine = {figure["test"]: figure["value"] for figure in figures if figure["test"].startswith("test_mine.py::")}
    assert [name[14:] for name in mine] == ["test_dynamics", "test_pose[planes]", "test_pose[registration]"]
    _, by_planes, by_registration = mine.values()
    assert 0 < by_registration < by_planes < 50  # um; plane by plane, a pose is less exact
    assert len(figures) == 7, "the guide's own pose estimator has four"


def test_its_second_version_is_held_to_the_first(outside):
    """On two workers: the same figures to the last digit, but for the one that was made worse."""
    error = "1e6 * np.linalg"
    worse = PROJECT.replace("limit=50)", "limit=500)").replace(error, f"(10 if method == 'planes' else 1) * {error}")
    (outside / "test_mine.py").write_text(worse)
    options = ("-n", "2", "--accuracy-compare", "first", "--accuracy-fail", "0.2")
    again = run("venv/bin/python", "-m", "pytest", "test_mine.py", *options, cwd=outside)
    assert again.returncode == 1, again.stdout + again.stderr
    assert "4 passed" in again.stdout
    assert again.stdout.count("+0.0%") == 2
    assert [line.partition(" is ")[0] for line in again.stdout.splitlines() if line.startswith("worse by")] == [
        "worse by more than 20%: test_mine.py::test_pose[planes]: position error"
    ]
    assert "4 of 7 figures saved as first were not measured now" in again.stdout


def test_its_command_line_prints_the_table(outside):
    done = run("venv/bin/python", "-m", "identify.accuracy", ".accuracy/first.json", cwd=outside)
    lines = done.stdout.splitlines()
    assert lines[0] == "| figure | value | 95% interval | unit | limit | margin |"
    assert len(lines) == 9
    missing = run("venv/bin/python", "-m", "identify.accuracy", ".accuracy/second.json", cwd=outside)
    assert missing.returncode == 1
    assert len(missing.stderr.splitlines()) == 1, missing.stderr
