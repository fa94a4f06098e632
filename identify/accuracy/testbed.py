"""Fixtures that bring the testbed: scenario, robot and sensor, seeded by the test's name.

A test names others than the built-in ones by `@pytest.mark.cmmsim(sensor="mine.toml")`, the command line for all tests
that do not by `--accuracy-sensor mine.toml`. Nothing heavy is imported before a test asks for one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from identify.accuracy.figure import AccuracyError

if TYPE_CHECKING:
    from cmmsim import Sensor, Taught
    from dynamics import Robot
    from identify import Scenario

MARKER = "cmmsim"
CHOICES = ("scenario", "robot", "sensor")
DEFAULT_SCENARIO = "quick"


def check_options(config: pytest.Config) -> None:
    """Raise pytest.UsageError where the command line names a scenario, robot or sensor that cannot be loaded."""
    chosen = _from_options(config)
    if not chosen:
        return
    from cmmsim.errors import CmmError
    from cmmsim.files.sensor_file import read_sensor_file
    from dynamics import DynamicsError, load_robot
    from identify import IdentifyError, load_scenario

    load: dict[str, Callable[[str], object]]
    load = {"scenario": load_scenario, "robot": load_robot, "sensor": read_sensor_file}
    for what, name in chosen.items():
        try:
            load[what](name)
        except (CmmError, DynamicsError, IdentifyError) as error:
            raise pytest.UsageError(f"--accuracy-{what}: {error}") from error


def node_id(item: pytest.Item) -> str:
    """Node id of a test, without the group that pytest-xdist appends with --dist loadgroup."""
    return f"{item.parent.nodeid}::{item.name}" if item.parent else item.nodeid


@pytest.fixture
def cmmsim_seed(request: pytest.FixtureRequest) -> int:
    """Seed of this test: always the same for the same node id and --accuracy-seed, another for every other test."""
    text = f"{request.config.getoption('accuracy_seed')} {node_id(request.node)}"
    return int.from_bytes(sha256(text.encode()).digest()[:4], "big")


@pytest.fixture
def cmmsim_scenario(request: pytest.FixtureRequest) -> Scenario:
    """The scenario, with the robot and the sensor that were chosen beside it."""
    from identify import load_scenario

    chosen = _choices(request)
    scenario = load_scenario(chosen.pop("scenario", DEFAULT_SCENARIO))
    return scenario.with_overrides(chosen) if chosen else scenario


@pytest.fixture
def cmmsim_robot(cmmsim_scenario: Scenario) -> Robot:
    """The scenario's robot."""
    from dynamics import load_robot

    return load_robot(cmmsim_scenario.robot)


@pytest.fixture(scope="session")
def cmmsim_taught() -> dict[str, Taught]:
    """What each sensor was taught, by what teaching depends on: it takes seconds, and is done once a process."""
    return {}


@pytest.fixture
def cmmsim_sensor(
    request: pytest.FixtureRequest,
    cmmsim_scenario: Scenario,
    cmmsim_robot: Robot,
    cmmsim_seed: int,
    cmmsim_taught: dict[str, Taught],
) -> Sensor:
    """The scenario's sensor at the start of a run; its noise is this test's, its teaching that of all tests."""
    from identify.experiment.sensor_in_loop import make_sensor

    key = cmmsim_scenario.model_dump_json(include={"sensor", "sensor_changes", "timing", "renderer"})
    if key not in cmmsim_taught:
        seed = request.config.getoption("accuracy_seed")
        cmmsim_taught[key] = make_sensor(cmmsim_scenario, cmmsim_robot, seed).teach()
    return make_sensor(cmmsim_scenario, cmmsim_robot, cmmsim_seed, cmmsim_taught[key])


def _choices(request: pytest.FixtureRequest) -> dict[str, str]:
    """Names or files of what this test uses: from the command line, replaced by its markers, the closest last."""
    chosen = _from_options(request.config)
    for mark in reversed(list(request.node.iter_markers(MARKER))):
        unknown = [repr(key) for key in mark.kwargs if key not in CHOICES] + [repr(value) for value in mark.args]
        if unknown:
            raise AccuracyError(f"marker {MARKER}: {', '.join(unknown)} unknown; it takes {', '.join(CHOICES)}")
        for what, name in mark.kwargs.items():
            if not isinstance(name, str | PathLike):
                raise AccuracyError(f"marker {MARKER}: {what} is {name!r}, must be a built-in name or a file")
        chosen |= {what: _file_or_name(request.path.parent, name) for what, name in mark.kwargs.items()}
    return chosen


def _from_options(config: pytest.Config) -> dict[str, str]:
    start = config.invocation_params.dir
    given = {what: config.getoption(f"accuracy_{what}") for what in CHOICES}
    return {what: _file_or_name(start, name) for what, name in given.items() if name is not None}


def _file_or_name(folder: Path, name: str | PathLike[str]) -> str:
    """The file of that name in the folder, or else the name as it is, which may be a built-in one."""
    path = folder / name
    return str(path) if path.is_file() else str(name)
