"""The figures that the README quotes, and the file that keeps them.

    pytest tests/benchmarks -m slow --dynamics-figures .readme/dynamics.json

measures them again, on a machine with nothing else to do. The file is written when every figure was measured and its
goal reached; otherwise it stays as it was. The README's table then takes the new figures over: `pytest
tests/test_readme.py` prints the rows that it wants.
"""

import json
import os
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import pytest

from identify.files.atomic import write_text

FIGURES = (
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
)
PACKAGES = ("cmmsim", "numpy", "casadi", "pin", "mujoco")

measured = pytest.StashKey[dict[str, float]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--dynamics-figures", metavar="FILE", type=Path, help="write the measured figures of the dynamics into a file"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[measured] = {}


@pytest.fixture(scope="session")
def quote(pytestconfig: pytest.Config) -> Callable[..., None]:
    """(name=value, ...) keeps figures for the README."""

    def keep(**figures: float) -> None:
        assert set(figures) <= set(FIGURES)
        pytestconfig.stash[measured].update({name: float(f"{value:.4g}") for name, value in figures.items()})

    return keep


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.getoption("--dynamics-figures", default=None)
    found = session.config.stash.get(measured, {})
    if path is None:
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    missing = [name for name in FIGURES if name not in found]
    if missing or session.testsfailed:
        skipped = [str(report.longrepr[2]) for report in reporter.stats.get("skipped", [])]
        lines = [f"{session.testsfailed} tests failed", *skipped, f"not measured: {', '.join(missing)}"]
        reporter.write_line("\n".join([f"\n{path} stays as it was:", *lines]))
        return
    entry = {
        "date": datetime.now(UTC).date().isoformat(),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "versions": {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}},
        "figures": {name: found[name] for name in FIGURES},
    }
    write_text(path, json.dumps(entry, indent=2) + "\n")
    reporter.write_line(f"\nwritten: {path}")
