"""The guide in a project outside this one, in an environment of its own where the distribution is a
wheel.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("cmmsim", "dynamics", "identify")
GUIDE = Path(__file__).parent / "guide"
FILES = sorted(GUIDE.glob("test_*.py"))
TEXT = (GUIDE / "README.md").read_text(encoding="utf-8")

INSTALLED = """
import cmmsim
import numpy as np
import pytest


def test_installed(request):
    assert request.config.rootpath.as_posix() in cmmsim.__file__


@pytest.mark.cmmsim(scenario="mine.toml")
def test_dynamics(accuracy, cmmsim_robot, cmmsim_scenario):
    assert cmmsim_scenario.name == "mine"
    pose, motion = cmmsim_robot.home_pose, np.array([0.1, 0.0, 0.2, 0.3, -0.2, 0.1])
    torque = cmmsim_robot.inverse_dynamics(pose, motion, motion)
    error = np.abs(cmmsim_robot.forward_dynamics(pose, motion, torque) - motion).max()
    accuracy.record("forward after inverse dynamics", error, unit="m/s2", limit=1e-9)
"""

SENSOR = """
import numpy as np
import pytest


@pytest.mark.parametrize("method", ["planes", "registration"])
def test_pose(accuracy, cmmsim_sensor, cmmsim_seed, method):
    cmmsim_sensor.method = method
    poses = cmmsim_sensor.home + 0.003 * np.random.default_rng(cmmsim_seed).uniform(-1, 1, (8, 6))
    errors = [1e6 * np.linalg.norm((cmmsim_sensor.measure(pose).pose - pose)[:3]) for pose in poses]
    accuracy.sample("position error", errors, unit="um", limit=50)
"""


def run(*command, cwd):
    """Outcome of a command that knows nothing of this checkout."""
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("PYTHONPATH", "PYTEST_ADDOPTS")
    }
    return subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """A folder with an environment `venv`: the wheel, built from a copy of the sources, and beside
    it the packages of this interpreter, on which it depends."""
    folder, source = tmp_path_factory.mktemp("outside"), tmp_path_factory.mktemp("source")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip, python = (
        (sys.executable, "-m", "pip", "--disable-pip-version-check"),
        folder / "venv" / "bin" / "python",
    )
    built = run(*pip, "wheel", "--no-deps", "--wheel-dir", folder, source, cwd=folder)
    if "Could not find a version that satisfies the requirement setuptools" in built.stderr:
        pytest.skip("no package index to take the build's setuptools from")
    assert built.returncode == 0, built.stderr
    assert (
        run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder).returncode
        == 0
    )
    installed = run(
        *pip, "--python", python, "install", "--no-deps", next(folder.glob("*.whl")), cwd=folder
    )
    assert installed.returncode == 0, installed.stderr
    (packages(folder) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (folder / "mine.toml").write_text('name = "mine"\n')
    return folder


def packages(folder):
    """Where an environment keeps them."""
    return next((folder / "venv" / "lib").glob("python*/site-packages"))


def test_the_guide_names_every_option_and_every_file_and_no_other(pytestconfig):
    named = set(re.findall(r"--accuracy-[a-z]+", TEXT))
    known = {name for name in dir(pytestconfig.option) if name.startswith("accuracy_")}
    assert {name[2:].replace("-", "_") for name in named} | {
        "accuracy_robot",
        "accuracy_scenario",
    } == known
    assert "likewise for `robot` and `scenario`" in TEXT
    assert set(re.findall(r"\]\(([^)]+)\)", TEXT)) == {path.name for path in FILES}


def files_of_the_packages():
    """Paths within this checkout."""
    files = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()]
    return [path.relative_to(ROOT) for path in files if path.suffix not in (".pyc", ".nbc", ".nbi")]


def test_every_file_of_the_packages_is_code_or_of_a_kind_that_wheels_hold():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    data = tomllib.loads(text)["tool"]["setuptools"]["package-data"]["*"]
    kinds = ("*.py", *data)
    wanted = files_of_the_packages()
    assert len(wanted) > 200
    assert [path for path in wanted if not any(path.match(kind) for kind in kinds)] == []


@pytest.mark.thorough
def test_the_wheel_holds_every_file_of_the_packages(outside):
    wanted = files_of_the_packages()
    assert [path for path in wanted if not (packages(outside) / path).exists()] == []


@pytest.mark.thorough
@pytest.mark.rendering
def test_the_guides_example_and_its_complete_files_run_where_the_wheel_is_installed(outside):
    """What the files test is held to limits that it meets and could miss."""
    (outside / "test_installed.py").write_text(INSTALLED)
    (outside / "test_example.py").write_text(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)[0])
    for file in FILES:
        shutil.copy(file, outside)
    pytest_ = (
        "venv/bin/python",
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:hypothesispytest",
    )
    done = run(*pytest_, "--strict-markers", "--accuracy-save", "mine", cwd=outside)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{3 + len(FILES)} passed" in done.stdout
    saved = json.loads((outside / ".accuracy" / "mine.json").read_text())["figures"]
    assert len(saved) == 1 + 2 + 4 * len(FILES)
    for file in FILES:
        held = [
            f for f in saved if f["test"].startswith(f"{file.name}::") and f["limit"] is not None
        ]
        assert [figure["unit"] for figure in held] == ["um", "urad"]
        assert all(figure["limit"] / 10 < figure["value"] < figure["limit"] for figure in held), (
            held
        )
    table = run(
        "venv/bin/python", "-m", "identify.accuracy", ".accuracy/mine.json", cwd=outside
    ).stdout.splitlines()
    assert table[0] == "| test | figure | value | 95% interval | n | unit | limit | margin |"
    assert len(table) == 2 + len(saved)


@pytest.mark.thorough
@pytest.mark.rendering
def test_a_second_version_is_held_to_the_first(outside):
    """On two workers: the same figures to the last digit, but for the one that was made worse."""
    test = outside / "test_pose.py"
    test.write_text(SENSOR)
    pytest_ = ("venv/bin/python", "-m", "pytest", "test_pose.py")
    first = run(*pytest_, "--accuracy-save", "first", cwd=outside)
    assert first.returncode == 0, first.stdout + first.stderr
    figures = json.loads((outside / ".accuracy" / "first.json").read_text())["figures"]
    by_planes, by_registration = (figure["value"] for figure in figures)
    assert 0 < by_registration < by_planes < 50  # um; plane by plane, a pose is less exact
    error = "1e6 * np.linalg"
    worse = SENSOR.replace("limit=50)", "limit=500)").replace(
        error, f"(10 if method == 'planes' else 1) * {error}"
    )
    test.write_text(worse)
    again = run(
        *pytest_, "-n", "2", "--accuracy-compare", "first", "--accuracy-fail", "0.2", cwd=outside
    )
    assert again.returncode == 1, again.stdout + again.stderr
    assert again.stdout.count("+0.0%") == 1
    assert [
        line.partition(" is ")[0]
        for line in again.stdout.splitlines()
        if line.startswith("worse by")
    ] == ["worse by more than 20%: test_pose.py::test_pose[planes]: position error"]
