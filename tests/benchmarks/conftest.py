"""The figures that the README quotes, and the files that keep them.

    pytest tests/benchmarks -m thorough --dynamics-figures .readme/dynamics.json --sensor-figures .readme/sensor.json

(a part of `sh .ci/thorough`) measure them again, on a machine with nothing else to do. A file is written when each of
its figures was measured and its goal reached; otherwise it stays as it was. The README's tables then take the new
figures over: `pytest tests/test_readme.py` prints the rows that it wants.
"""

import json
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import pytest

from identify.files.atomic import write_text


@dataclass(frozen=True)
class Quoted:
    """Figures that one file keeps, and the packages whose versions stand beside them."""

    figures: tuple[str, ...]
    packages: tuple[str, ...]


QUOTED = {
    "dynamics": Quoted(
        (
            "forward_dynamics_over_pinocchio",
            "forward_dynamics_over_mj_step",
            "pinocchio_relative_difference",
            "mujoco_position_steady_um",
            "mujoco_angle_steady_urad",
            "times_real_time",
            "sensitivities_plain_runs",
            "two_cores_gain",
            "first_compilation_s",
            "integrator_order",
        ),
        ("cmmsim", "numpy", "casadi", "pin", "mujoco"),
    ),
    "sensor": Quoted(
        (
            "analytic_frames_a_second",
            "pyrender_frames_a_second",
            "analytic_times_straightforward",
            "pyrender_times_straightforward",
        ),
        ("cmmsim", "numpy", "numba", "opencv-python-headless", "pyrender", "trimesh"),
    ),
}

measured = pytest.StashKey[dict[str, float]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    for name in QUOTED:
        said = f"write the measured figures of the {name} into a file"
        parser.addoption(f"--{name}-figures", metavar="FILE", type=Path, help=said)


def pytest_configure(config: pytest.Config) -> None:
    config.stash[measured] = {}


@pytest.fixture(scope="session")
def quote(pytestconfig: pytest.Config) -> Callable[..., None]:
    """(name=value, ...) keeps figures for the README."""
    known = {figure for quoted in QUOTED.values() for figure in quoted.figures}

    def keep(**figures: float) -> None:
        assert set(figures) <= known
        pytestconfig.stash[measured].update({name: float(f"{value:.4g}") for name, value in figures.items()})

    return keep


def pytest_sessionfinish(session: pytest.Session) -> None:
    found = session.config.stash.get(measured, {})
    for name, quoted in QUOTED.items():
        path = session.config.getoption(f"--{name}-figures", default=None)
        if path is not None:
            said = _unfinished(session, quoted, found) or _written(path, quoted, found)
            session.config.pluginmanager.get_plugin("terminalreporter").write_line(f"\n{path} {said}")


def _unfinished(session: pytest.Session, quoted: Quoted, found: dict[str, float]) -> str:
    """Why the file stays as it was; empty where it need not."""
    missing = [name for name in quoted.figures if name not in found]
    if not missing and not session.testsfailed:
        return ""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = [str(report.longrepr[2]) for report in reporter.stats.get("skipped", [])]
    lines = [f"{session.testsfailed} tests failed", *skipped, f"not measured: {', '.join(missing)}"]
    return "\n".join(["stays as it was:", *lines])


def _written(path: Path, quoted: Quoted, found: dict[str, float]) -> str:
    versions = {name: metadata.version(name) for name in quoted.packages}
    entry = {
        "date": datetime.now(UTC).date().isoformat(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "versions": {"python": platform.python_version(), **versions},
        "figures": {name: found[name] for name in quoted.figures},
    }
    write_text(path, json.dumps(entry, indent=2) + "\n")
    return "is written"
