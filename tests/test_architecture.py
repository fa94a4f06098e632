"""The layers of the packages: by import-linter's contracts, and once more by reading the import statements."""

import ast
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("cmmsim", "dynamics", "identify")
ESTIMATOR = ("identify/estimation", "identify/estimators")
ONLY_IMPORTER = {
    "pyrender": "cmmsim/imaging/pyrender_renderer.py",
    "mujoco": "dynamics/engines/mujoco_engine.py",
    "dask": "identify/studies/dask_cluster.py",
    "distributed": "identify/studies/dask_cluster.py",
}


@cache
def imports(path: Path) -> frozenset[str]:
    """Full names of the modules that a file imports, wherever in the file; packages import absolutely."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} imports relatively"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def imported(folder: str) -> dict[str, set[str]]:
    """Top-level names that each file of a folder imports."""
    files = sorted((ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT).as_posix(): {name.split(".")[0] for name in imports(path)} for path in files}


def test_import_linter_keeps_every_contract():
    from importlinter.cli import lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("dynamics", {"cmmsim", "identify", "cv2", "pyrender", "trimesh"}),
        ("cmmsim", {"dynamics", "identify", "casadi"}),
    ],
)
def test_lower_packages_know_neither_each_other_nor_identify(package, forbidden):
    assert {file: names & forbidden for file, names in imported(package).items() if names & forbidden} == {}


@pytest.mark.parametrize("library", ONLY_IMPORTER)
def test_heavy_libraries_have_one_importer(library):
    importers = [file for package in PACKAGES for file, names in imported(package).items() if library in names]
    assert importers == [ONLY_IMPORTER[library]]


@pytest.mark.parametrize("room", ESTIMATOR)
def test_estimator_sees_neither_sensor_nor_truth(room):
    files = sorted((ROOT / room).glob("*.py"))
    assert len(files) > 3
    names = {name for path in files for name in imports(path)}
    assert not [n for n in names if n.split(".")[0] == "cmmsim" or n.startswith("identify.experiment")]


def test_contracts_name_the_rooms_that_these_tests_read():
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    sources = {m for c in config["tool"]["importlinter"]["contracts"] for m in c.get("source_modules", [])}
    assert {room.replace("/", ".") for room in ESTIMATOR} <= sources


def test_no_file_is_longer_than_a_reader_can_hold():
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    assert {path.name: n for path in files if (n := len(path.read_text("utf-8").splitlines())) > 400} == {}
