"""The examples in docstrings of public names, each run as it stands there."""

import doctest
import inspect

import numpy as np
import pytest

import cmmsim

WITH_METHODS = ("Sensor", "Tracker", "FaultGenerator", "StereoFrame")


def _public():
    """Public functions and classes, and the methods of the classes that measure, by name."""
    found = {name: getattr(cmmsim, name) for name in cmmsim.__all__}
    for name in WITH_METHODS:
        for method, value in inspect.getmembers(found[name], inspect.isfunction):
            if not method.startswith("_"):
                found[f"{name}.{method}"] = value
    return found


PUBLIC = _public()


@pytest.fixture(scope="module")
def sensor():
    """A taught sensor, of which the examples speak."""
    made = cmmsim.load_sensor("ctrack780", renderer="statistical")
    made.teach()
    return made


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_says_what_it_takes_and_gives_and_its_example_runs(name, sensor, monkeypatch):
    monkeypatch.setenv("CMMSIM_PLUGINS", "")  # and what an example allows ends with it
    value = PUBLIC[name]
    text = inspect.getdoc(value)
    if inspect.isroutine(value):
        taken = set(inspect.signature(value).parameters) - {"self"}
        nothing = inspect.signature(value).return_annotation in (None, "None")
        assert "Parameters\n---" in text or not taken
        assert "Returns\n---" in text or nothing
        assert "Raises\n---" in text or not taken
    names = {"np": np, "sensor": sensor} | vars(inspect.getmodule(value))
    tests = doctest.DocTestFinder(recurse=False).find(value, name, globs=names)
    needed = not (
        name == "require_opengl"  # where there is none, it raises
        or "." in name
        or (inspect.isclass(value) and issubclass(value, Exception))
    )
    assert any(one.examples for one in tests) or not needed
    runner, said = doctest.DocTestRunner(verbose=False), []
    for one in tests:
        runner.run(one, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
