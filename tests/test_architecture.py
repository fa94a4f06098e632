"""The layers of the packages: by import-linter's contracts, and once more by reading the import statements."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("cmmsim", "dynamics", "identify")
ESTIMATOR = ("identify/estimation", "identify/estimators")
HEAVY = {
    "pyrender": {"cmmsim/imaging/pyrender_renderer.py"},
    "mujoco": {"dynamics/engines/mujoco_engine.py"},
    "dask": {"identify/studies/dask_cluster.py"},
    "distributed": {"identify/studies/dask_cluster.py"},
    "rerun": set(),
}


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = path.relative_to(ROOT).with_suffix("").parts[: -node.level] if node.level else ()
            module = ".".join([*package, *([node.module] if node.module else [])])
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def top_level(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imports(path)}


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
    assert files(package)
    offenders = {str(p.relative_to(ROOT)): sorted(top_level(p) & forbidden) for p in files(package)}
    assert not {name: found for name, found in offenders.items() if found}


@pytest.mark.parametrize("library", HEAVY)
def test_heavy_libraries_have_one_importer(library):
    importers = {p.relative_to(ROOT).as_posix() for name in PACKAGES for p in files(name) if library in top_level(p)}
    assert importers <= HEAVY[library]


@pytest.mark.parametrize("room", ESTIMATOR)
def test_estimator_sees_neither_sensor_nor_truth(room):
    assert len(files(room)) > 5
    names = {n for path in files(room) for n in imports(path)}
    assert not [n for n in names if n.split(".")[0] == "cmmsim" or n.startswith("identify.experiment")]


def test_contracts_name_the_rooms_that_these_tests_read():
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    sources = {m for c in config["tool"]["importlinter"]["contracts"] for m in c.get("source_modules", [])}
    assert {room.replace("/", ".") for room in ESTIMATOR} <= sources


def test_no_file_is_longer_than_a_reader_can_hold():
    long = {p.name: n for name in PACKAGES for p in files(name) if (n := len(p.read_text("utf-8").splitlines())) > 400}
    assert not long
