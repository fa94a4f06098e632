"""The examples in docstrings of public functions, each run as it stands there."""

import doctest
import inspect

import numpy as np
import pytest

import cmmsim

FUNCTIONS = [
    name
    for name in cmmsim.__all__
    if inspect.isroutine(getattr(cmmsim, name)) and name != "require_opengl"
]


@pytest.mark.parametrize("name", [*FUNCTIONS, "StereoFrame.show"])
def test_a_public_function_says_what_it_takes_and_gives_and_its_example_runs(name, monkeypatch):
    monkeypatch.setenv("CMMSIM_PLUGINS", "")  # and what an example allows ends with it
    value = cmmsim.StereoFrame.show if name == "StereoFrame.show" else getattr(cmmsim, name)
    text = inspect.getdoc(value)
    taken = set(inspect.signature(value).parameters) - {"self"}
    assert "Parameters\n---" in text or not taken
    assert "Returns\n---" in text
    assert "Raises\n---" in text or not taken
    names = {"np": np} | vars(inspect.getmodule(value))
    tests = doctest.DocTestFinder(recurse=False).find(value, name, globs=names)
    assert any(one.examples for one in tests)
    runner, said = doctest.DocTestRunner(verbose=False), []
    for one in tests:
        runner.run(one, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
