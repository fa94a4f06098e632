"""The examples in docstrings of public names, each run as it stands there."""

import doctest
import inspect

import numpy as np
import pytest

import dynamics
from dynamics import closed_loop, control

MODULES = dynamics, closed_loop, control


def _public():
    """Public functions, classes and the methods of Robot, by name."""
    found = {}
    for module in MODULES:
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isroutine(value) or inspect.isclass(value):
                found[f"{module.__name__}.{name}"] = value
    for name, value in inspect.getmembers(dynamics.Robot, inspect.isfunction):
        if not name.startswith("_"):
            found[f"Robot.{name}"] = value
    return found


PUBLIC = _public()


def _loop(robot):
    """Arguments of a run, as the example of `simulate_servo` makes them."""
    gains = closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    return {
        "parameters": robot.parameter_sets["truth"].vector,
        "still": closed_loop.Reference(np.tile(robot.home_pose, (3, 1)), np.zeros((3, 6))),
        "settings": closed_loop.LoopSettings(gains, closed_loop.FrameTiming(60.0)),
    }


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_says_what_it_takes_and_gives_and_its_example_runs(robot, name):
    value = PUBLIC[name]
    text = inspect.getdoc(value) or ""
    if inspect.isroutine(value):
        taken = set(inspect.signature(value).parameters) - {"self"}
        assert "Parameters\n---" in text or not taken
        nothing = inspect.signature(value).return_annotation in (None, "None")
        assert "Returns\n---" in text or nothing
        assert "Raises\n---" in text
    if inspect.isclass(value) and issubclass(value, Exception):
        return
    names = {"np": np, "robot": robot, "closed_loop": closed_loop} | _loop(robot)
    names |= vars(inspect.getmodule(value))
    tests = doctest.DocTestFinder(recurse=False).find(value, name, globs=names)
    examples = [example for one in tests for example in one.examples]
    assert examples, f"{name} has no example"
    runner = doctest.DocTestRunner(verbose=False)
    said = []
    for one in tests:
        runner.run(one, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
