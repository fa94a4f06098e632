"""Entry point of the pytest plugin: options, markers and fixtures. Imported at every start of pytest, so light."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

import pytest

from identify.accuracy.figure import PROPERTY
from identify.accuracy.session import AccuracySession
from identify.accuracy.testbed import (
    DEFAULT_SCENARIO,
    MARKER,
    check_options,
    cmmsim_robot,
    cmmsim_scenario,
    cmmsim_seed,
    cmmsim_sensor,
    cmmsim_taught,
    node_id,
)

if TYPE_CHECKING:
    from identify.accuracy.figure import Accuracy

__all__ = ["accuracy", "cmmsim_robot", "cmmsim_scenario", "cmmsim_seed", "cmmsim_sensor", "cmmsim_taught"]


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
        check_options(config)
        config.pluginmanager.register(AccuracySession(config), "cmmsim_accuracy_session")


@pytest.fixture
def accuracy(request: pytest.FixtureRequest) -> Accuracy:
    """Record figures of accuracy: `accuracy.record(name, value, ...)`, `accuracy.sample(name, values, ...)`."""
    from identify.accuracy.figure import Accuracy

    properties = request.node.user_properties
    properties[:] = [entry for entry in properties if entry[0] != PROPERTY]  # of an earlier try of the same test
    return Accuracy(node_id(request.node), properties)


def ratio(text: str) -> float:
    """What --accuracy-fail takes."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"RATIO is {text}, must be 0 or more, such as 0.1 for 10 %")
    return value


def seed(text: str) -> int:
    """What --accuracy-seed takes."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"the seed is {text}, must be 0 or more")
    return value
