"""What a stranger meets first: public names, their help and types, what starts, and rooms that
import downwards.
"""

import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import identify

PACKAGES = ("cmmsim", "dynamics", "identify")
ROOT = Path(__file__).parents[1]
SOURCES = {
    path: path.read_text("utf-8") for name in PACKAGES for path in (ROOT / name).rglob("*.py")
}
HEAVY = ("casadi", "cv2", "numba", "numpy", "pydantic", "pyrender", "scipy", "xarray")
PYTEST = (
    "import pytest; assert pytest.main(['-p', 'no:hypothesispytest', '--accuracy-seed', '0']) == 5"
)

SCRIPT = """
import cmmsim
import dynamics
import identify

scenario = identify.load_scenario("quick")
robot = dynamics.load_robot(scenario.robot)
result = identify.identify(identify.run_experiment(scenario), robot, scenario)
reveal_type(result)
reveal_type(robot)
reveal_type(cmmsim.load_sensor("ctrack780"))
identify.estimate
"""
# Of what we import from others nothing is asked here, and reading it all takes most of the time.
MYPY_CONFIG = """
[mypy]
follow_imports = skip
[mypy-cmmsim.*,dynamics.*,identify.*]
follow_imports = normal
"""


def python(*arguments, cwd, path=()):
    """A process that finds the packages where they are installed, and before them what lies in a
    path.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_every_name_that_identify_offers_is_in_its_help_can_be_had_and_has_a_signature_that_can_be_read():
    """Types stand in signatures by their names: spelled out, `ArrayLike` alone takes 200
    characters.
    """
    offered = {name: getattr(identify, name) for name in identify.__all__}
    assert [name for name in offered if not re.search(rf"\b{name}\b", identify.__doc__)] == []
    assert len(offered) <= 18
    assert (
        max(len(str(inspect.signature(value))) for name, value in offered.items() if name.islower())
        < 400
    )
    assert all(value.__name__ == name for name, value in offered.items())
    assert set(offered) < set(dir(identify))
    with pytest.raises(
        AttributeError, match="no attribute 'estimate'; it has IdentifyError, Scenario, "
    ):
        _ = identify.estimate


@pytest.mark.parametrize(
    ("start", "heavy"),
    [
        ("import identify", HEAVY),
        ("import cmmsim", HEAVY),
        ("import identify.__main__", HEAVY),
        (PYTEST, HEAVY),
        ("import identify.studies.runner", ["scipy.stats", "matplotlib"]),  # a process of a study
    ],
)
def test_nothing_heavy_is_imported_before_it_is_wanted(start, heavy, tmp_path):
    """Not at the start of pytest either, for who has the package installed and tests something
    else.
    """
    text = f"import sys; {start}; print([name for name in {heavy} if name in sys.modules])"
    assert python("-c", text, cwd=tmp_path, path=[ROOT]).stdout.endswith("[]\n")


@pytest.mark.thorough
def test_a_type_checker_follows_the_installed_packages(tmp_path):
    """In the environment of this test, from a folder that knows nothing of the checkout."""
    (tmp_path / "mine.py").write_text(SCRIPT)
    (tmp_path / "mypy.ini").write_text(MYPY_CONFIG)
    said = python("-m", "mypy", "--cache-dir", tmp_path / "cache", "mine.py", cwd=tmp_path).stdout
    types = re.findall(r'Revealed type is "[\w.]*\b(\w+)"', said)
    assert types == ["IdentificationResult", "Robot", "Sensor"], (
        f"{said}\ninstalled otherwise than by sh .ci/setup?"
    )
    assert '"estimate"  [attr-defined]' in said
    assert said.count("error:") == 1


@pytest.mark.parametrize("rooms", [[], ["errors.py", "scenario"]])
@pytest.mark.slow
def test_a_foreign_package_of_the_name_identify_is_named(tmp_path, rooms):
    """PyPI's, whose `__init__.py` is empty, lies in a folder before ours, or was installed over
    ours.
    """
    foreign = tmp_path / "identify"
    foreign.mkdir()
    (foreign / "__init__.py").touch()
    for room in rooms:
        (foreign / room).symlink_to(ROOT / "identify" / room)
    said = (
        f"another package is imported instead of cmmsim's `identify`: {foreign}; install "
        "cmmsim into a virtual"
    )
    warned = python("-c", "from cmmsim import load_sensor", cwd=tmp_path, path=[tmp_path, ROOT])
    assert warned.returncode == 0
    assert f"UserWarning: {said}" in warned.stderr
    command = python(
        "-W", "error::RuntimeWarning", "-m", "cmmsim", cwd=tmp_path, path=[tmp_path, ROOT]
    )
    assert command.returncode == 1
    assert command.stderr.startswith(f"error: {said}")
    assert command.stderr.count("\n") == 1


def test_beside_the_package_of_pre_commit_the_command_refuses_with_the_reason(tmp_path):
    """Installed before ours, which replaced its `__init__.py`: only its metadata tells."""
    other = tmp_path / "identify-2.6.9.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: identify\nVersion: 2.6.9\n")
    command = python(
        "-c", "import cmmsim.__main__ as c; c.main()", cwd=tmp_path, path=[ROOT, tmp_path]
    )
    assert command.returncode == 1
    assert command.stderr.startswith(
        "error: another package, identify 2.6.9 of PyPI, is installed in the same environment; "
        "install cmmsim into a virtual environment of its own"
    )
    assert command.stderr.count("\n") == 1


def test_the_citation_names_this_version_its_licence_and_the_paper():
    stated = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    heading = f"## {stated['version']} ({stated['date-released']})\n"
    assert heading in (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert (stated["version"], stated["license"]) == (project["version"], project["license"])
    assert stated["authors"][0]["name"].lower() in (ROOT / "LICENSE").read_text("utf-8").lower()
    assert set(stated["keywords"]) == set(project["keywords"])
    assert stated["references"][0]["doi"] == "10.3390/electronics8080836"


def test_every_file_that_the_packages_need_is_named_for_the_wheel():
    """`sh .ci/wheel` builds and installs one; here what git knows is held against the patterns."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["*"]
    found = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()]
    others = [path for path in found if path.suffix != ".py" and path.parent.name != "__pycache__"]
    assert len(others) > 30
    assert [path for path in others if not any(path.match(pattern) for pattern in patterns)] == []


def test_import_linter_keeps_every_contract():
    """Sensor and robot know neither each other nor `identify`; estimators know neither sensor nor
    truth.
    """
    from importlinter.cli import lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


@pytest.mark.parametrize(
    ("room", "forbidden"), [("dynamics", "cv2|trimesh"), ("cmmsim", "casadi"), ("", r"\.")]
)
def test_robots_draw_no_images_the_sensor_needs_no_casadi_and_no_file_imports_relatively(
    room, forbidden
):
    imports = re.compile(rf"^\s*(from|import) ({forbidden})", re.MULTILINE)
    assert [
        path
        for path, text in SOURCES.items()
        if path.is_relative_to(ROOT / room) and imports.search(text)
    ] == []


def test_no_file_is_longer_than_a_reader_can_hold():
    assert len(SOURCES) > 100
    assert {
        path.name: n for path, text in SOURCES.items() if (n := len(text.splitlines())) > 400
    } == {}
