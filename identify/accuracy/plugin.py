"""The pytest plugin: its options, its marker, and the fixtures that record figures and bring the testbed.

A test names a scenario, robot or sensor other than the built-in ones by `@pytest.mark.cmmsim(sensor="mine.toml")`, the
command line for all tests that do not by `--accuracy-sensor mine.toml`. Imported at every start of pytest, so light:
nothing heavy is imported before a test asks for the testbed.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from identify.accuracy.figure import PROPERTY, Accuracy, AccuracyError
from identify.accuracy.session import AccuracySession

if TYPE_CHECKING:
    from cmmsim import Sensor, Taught
    from dynamics import Robot
    from identify import Scenario

MARKER = "cmmsim"
CHOICES = ("scenario", "robot", "sensor")
DEFAULT_SCENARIO = "quick"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the group `accuracy`."""
    group = parser.getgroup("accuracy", "accuracy benchmarks (cmmsim)")
    add = group.addoption
    add(
        "--accuracy-save",
        metavar="NAME",
        help="save the figures of a session that passes, unless NAME holds others, or one is beyond its limit",
    )
    add("--accuracy-compare", metavar="NAME", help="show saved figures and the change from them in the table")
    add(
        "--accuracy-fail",
        metavar="RATIO",
        type=ratio,
        help="fail when a figure is worse than the one compared with by more than RATIO of it, such as 0.1 "
        "(a sample: when both intervals say so), when it is of fewer values, or one number instead of a sample or the "
        "other way round, or when its test ran or was skipped and did not record it",
    )
    add("--accuracy-dir", metavar="DIR", help="folder of saved figures (default: .accuracy in the root directory)")
    add("--accuracy-seed", metavar="N", type=seed, default=0, help="seed of the testbed's fixtures (default: 0)")
    add(
        "--accuracy-scenario",
        metavar="NAME",
        help=f"scenario of the testbed, built-in or a file (default: {DEFAULT_SCENARIO})",
    )
    add("--accuracy-robot", metavar="NAME", help="robot, built-in or a file, instead of the scenario's")
    add("--accuracy-sensor", metavar="NAME", help="sensor, built-in or a file, instead of the scenario's")


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker; check the options and follow the session where its reports arrive."""
    config.addinivalue_line(
        "markers",
        f"{MARKER}(scenario=..., robot=..., sensor=...): what the cmmsim_ fixtures of a test load; built-in names, "
        "or files beside the test's file",
    )
    if not hasattr(config, "workerinput"):
        _check_options(config)
        config.pluginmanager.register(AccuracySession(config), "cmmsim_accuracy_session")


@pytest.fixture
def accuracy(request: pytest.FixtureRequest) -> Accuracy:
    """Record figures of accuracy: `accuracy.record(name, value, ...)`, `accuracy.sample(name, values, ...)`."""
    properties = request.node.user_properties
    properties[:] = [entry for entry in properties if entry[0] != PROPERTY]  # of an earlier try of the same test
    return Accuracy(_node_id(request.node), properties)


@pytest.fixture
def cmmsim_seed(request: pytest.FixtureRequest) -> int:
    """Seed of this test: always the same for the same node id and --accuracy-seed, another for every other test."""
    text = f"{request.config.getoption('accuracy_seed')} {_node_id(request.node)}"
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


def _check_options(config: pytest.Config) -> None:
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


def _node_id(item: pytest.Item) -> str:
    """Node id of a test, without the group that pytest-xdist appends with --dist loadgroup."""
    return f"{item.parent.nodeid}::{item.name}" if item.parent else item.nodeid


def ratio(text: str) -> float:
    """Value of --accuracy-fail; the parser names this function where it is no number."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"RATIO is {text}, must be 0 or more, such as 0.1 for 10 %")
    return value


def seed(text: str) -> int:
    """Value of --accuracy-seed."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"the seed is {text}, must be 0 or more")
    return value
