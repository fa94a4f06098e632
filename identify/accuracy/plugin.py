"""Plugin of pytest: its options, its marker, and the fixtures that record figures.

A test can choose its scenario, robot or sensor by `@pytest.mark.cmmsim(sensor="mine.toml")`. The
option `--accuracy-sensor mine.toml` chooses the sensor of all other tests. Pytest imports this
module at every start, so slow imports are made only when a test uses a fixture.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from identify.accuracy.figure import PROPERTY, Accuracy, AccuracyError
from identify.accuracy.saved import Key, find_saved
from identify.accuracy.session import AccuracySession, saved_folder, test_name

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
        help="save the figures of a session that passes, unless a figure is beyond its limit or "
        "NAME holds figures that were not measured",
    )
    add(
        "--accuracy-compare",
        metavar="NAME",
        help="show saved figures, and the changes since, in the table",
    )
    add(
        "--accuracy-fail",
        metavar="RATIO",
        type=ratio,
        help="fail if a figure is worse than the saved figure by more than RATIO of it, such as "
        "0.1 (for samples: if even the nearest ends of both intervals are), if it has fewer "
        "values, if a sample has become a single number or the reverse, or if its test ran or was "
        "skipped without recording it; fail also if none of the saved figures was measured",
    )
    add(
        "--accuracy-dir",
        metavar="DIR",
        help="folder of the saved figures (default: .accuracy in the root directory or the "
        "nearest folder above that has one)",
    )
    add(
        "--accuracy-seed",
        metavar="N",
        type=seed,
        default=0,
        help="seed of the simulated sensor and robot (default: 0)",
    )
    add(
        "--accuracy-scenario",
        metavar="NAME",
        help=f"scenario of the fixtures, built-in or a file (default: {DEFAULT_SCENARIO})",
    )
    add(
        "--accuracy-robot",
        metavar="NAME",
        help="robot, built-in or a file, in place of the scenario's robot",
    )
    add(
        "--accuracy-sensor",
        metavar="NAME",
        help="sensor, built-in or a file, in place of the scenario's sensor",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker, check the options, and register the session in the main process."""
    config.addinivalue_line(
        "markers",
        f"{MARKER}(scenario=..., robot=..., sensor=...): choose scenario, robot or sensor of the "
        "cmmsim_ fixtures, by built-in names or by files beside the test's file",
    )
    if not hasattr(config, "workerinput"):
        _check_options(config)
        config.pluginmanager.register(AccuracySession(config), "cmmsim_accuracy_session")


@pytest.fixture(scope="session")
def _accuracy_saved_counts(request: pytest.FixtureRequest) -> Mapping[Key, int]:
    """Numbers of values of the figures that --accuracy-compare names, by test and name."""
    name = request.config.getoption("accuracy_compare")
    if name is None:
        return {}
    return {
        figure.key: figure.count
        for figure in find_saved(saved_folder(request.config), name).figures
    }


@pytest.fixture
def accuracy(request: pytest.FixtureRequest, _accuracy_saved_counts: Mapping[Key, int]) -> Accuracy:
    """Recorder of figures of accuracy.

    Returns
    -------
    Accuracy
        Recorder. Its method `record` records a number, and `sample` the mean of several values.

    Examples
    --------
    >>> def test_centre(accuracy):
    ...     accuracy.record("centre error", 0.013, unit="px", limit=0.02)
    """
    properties = request.node.user_properties
    # If a plugin repeats a failed test, the figures of the earlier try are still there.
    properties[:] = [entry for entry in properties if entry[0] != PROPERTY]
    return Accuracy(_name(request.node), properties, _accuracy_saved_counts)


@pytest.fixture
def cmmsim_seed(request: pytest.FixtureRequest) -> int:
    """Seed of this test. It depends only on the name of the test and on --accuracy-seed."""
    text = f"{request.config.getoption('accuracy_seed')} {_name(request.node)}"
    return int.from_bytes(sha256(text.encode()).digest()[:4], "big")


@pytest.fixture
def cmmsim_scenario(request: pytest.FixtureRequest) -> Scenario:
    """Scenario of the test, with its chosen robot and sensor."""
    from identify import load_scenario

    chosen = _choices(request)
    scenario = load_scenario(chosen.pop("scenario", DEFAULT_SCENARIO))
    return scenario.with_overrides(chosen) if chosen else scenario


@pytest.fixture
def cmmsim_robot(cmmsim_scenario: Scenario) -> Robot:
    """Robot of the test's scenario."""
    from dynamics import load_robot

    return load_robot(cmmsim_scenario.robot)


@pytest.fixture(scope="session")
def cmmsim_taught() -> dict[str, Taught]:
    """Cache of results of teaching, by the settings on which they depend.

    Teaching takes seconds, so each process teaches a sensor only once.
    """
    return {}


@pytest.fixture
def cmmsim_sensor(
    request: pytest.FixtureRequest,
    cmmsim_scenario: Scenario,
    cmmsim_robot: Robot,
    cmmsim_seed: int,
    cmmsim_taught: dict[str, Taught],
) -> Sensor:
    """Sensor of the test's scenario at the start of a run.

    Its noise depends on the seed of the test. Tests with the same sensor share the results of
    teaching.
    """
    from identify.setup import Setup

    # Teaching depends on these entries, also on the robot, whose legs can hide stickers.
    key = cmmsim_scenario.model_dump_json(
        include={"robot", "sensor", "sensor_changes", "timing", "renderer", "pose_method", "rig"}
    )
    plan = Setup(cmmsim_scenario).sensor_plan
    if key not in cmmsim_taught:
        seed = request.config.getoption("accuracy_seed")
        cmmsim_taught[key] = plan.make(cmmsim_robot, seed).teach()
    return plan.make(cmmsim_robot, cmmsim_seed, cmmsim_taught[key])


def _check_options(config: pytest.Config) -> None:
    """Check that the scenario, robot and sensor of the command line can be loaded.

    Raises
    ------
    pytest.UsageError
        One of them cannot be loaded.
    """
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
    """Return the names or files that this test uses.

    Markers replace the choices of the command line. Raises AccuracyError for invalid arguments of a
    marker.
    """
    chosen = _from_options(request.config)
    # Pytest returns the closest marker first, so it ends the reversed list and has priority.
    for mark in reversed(list(request.node.iter_markers(MARKER))):
        unknown = [repr(key) for key in mark.kwargs if key not in CHOICES] + [
            repr(value) for value in mark.args
        ]
        if unknown:
            raise AccuracyError(
                f"marker {MARKER}: {', '.join(unknown)} unknown; it takes {', '.join(CHOICES)}"
            )
        for what, name in mark.kwargs.items():
            if not isinstance(name, str | PathLike):
                raise AccuracyError(
                    f"marker {MARKER}: {what} is {name!r}, must be a built-in name or a file"
                )
        chosen |= {
            what: _file_or_name(request.path.parent, name) for what, name in mark.kwargs.items()
        }
    return chosen


def _from_options(config: pytest.Config) -> dict[str, str]:
    start = config.invocation_params.dir
    given = {what: config.getoption(f"accuracy_{what}") for what in CHOICES}
    return {what: _file_or_name(start, name) for what, name in given.items() if name is not None}


def _file_or_name(folder: Path, name: str | PathLike[str]) -> str:
    """Return the path of a file with this name in the folder, or the name if there is no file."""
    path = folder / name
    return str(path) if path.is_file() else str(name)


def _name(item: pytest.Item) -> str:
    """Return a test's name, without the group that pytest-xdist appends (--dist loadgroup)."""
    node = f"{item.parent.nodeid}::{item.name}" if item.parent else item.nodeid
    return test_name(item.path, node.partition("::")[2])


def ratio(text: str) -> float:
    """Convert the value of --accuracy-fail. The parser reports text that is not a number."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(
            f"RATIO is {text}, must be 0 or more, such as 0.1 for 10 %"
        )
    return value


def seed(text: str) -> int:
    """Convert the value of --accuracy-seed."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"the seed is {text}, must be 0 or more")
    return value
