"""The layers of the packages: by import-linter's contracts, and the lowest ones by reading the import statements."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in the file; packages import absolutely."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} imports relatively"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_import_linter_keeps_every_contract():
    from importlinter.cli import lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("dynamics", ("cmmsim", "identify", "cv2", "pyrender", "trimesh")),
        ("cmmsim", ("dynamics", "identify", "casadi")),
        ("identify/estimation", ("cmmsim", "identify.experiment")),
        ("identify/estimators", ("cmmsim", "identify.experiment")),
    ],
)
def test_sensor_and_robot_know_neither_each_other_nor_identify_and_estimators_neither_sensor_nor_truth(room, forbidden):
    files = {path.name: imports(path) for path in (ROOT / room).rglob("*.py")}
    assert len(files) > 3
    seen = {(file, name) for file, names in files.items() for name in names}
    assert {one for one in seen if f"{one[1]}.".startswith(tuple(f"{name}." for name in forbidden))} == set()


def test_no_file_is_longer_than_a_reader_can_hold():
    files = [path for package in ("cmmsim", "dynamics", "identify") for path in (ROOT / package).rglob("*.py")]
    assert {path.name: n for path in files if (n := len(path.read_text("utf-8").splitlines())) > 400} == {}
