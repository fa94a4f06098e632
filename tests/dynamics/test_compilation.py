"""The cache of compiled code: content as key, whole files only, no recompiling; and what happens without a compiler."""

import ctypes
import subprocess
import sys
import warnings
from dataclasses import replace
from inspect import getsource
from pathlib import Path
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest

from dynamics import closed_loop, compilation, load_robot, robot_file
from dynamics import robot as robot_module
from dynamics.errors import DynamicsError, SimulationError
from tests.dynamics.conftest import assert_same


@pytest.fixture
def own_cache(loop, tmp_path, monkeypatch):
    monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def _square(geometry):
    x = ca.SX.sym("x")
    return [ca.Function("square", [x], [x * x])]


def compiled_square(name="square", geometry=None, build=_square):
    return compilation.load_library(name, geometry or load_robot("rss6").geometry, build)


def test_code_is_compiled_once_per_content(robot, own_cache):
    """The second request builds nothing; another geometry or name is another file."""
    build = Mock(side_effect=_square)
    first = compiled_square(build=build)
    assert compiled_square(build=build) == first
    build.assert_called_once()
    assert float(ca.external("square", str(first))(3.0)) == 9.0
    shorter = replace(robot.geometry, crank_length=0.061)
    others = {compiled_square(geometry=shorter), compiled_square("cube", shorter)}
    assert len(others | {first}) == 3
    assert len(list(own_cache.iterdir())) == 3


def test_two_processes_that_compile_at_once_get_one_whole_library(own_cache):
    """Both end well with the same file, and no temporary file is left behind."""
    load = "import casadi as ca\nfrom dynamics import compilation, load_robot\n"
    code = "\n".join([load, getsource(_square), getsource(compiled_square), "print(compiled_square())"])
    command, folder = [sys.executable, "-c", code], Path(__file__).parents[2]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) for _ in range(2)]
    paths = {process.communicate(timeout=60)[0].strip() for process in processes}
    assert [process.returncode for process in processes] == [0, 0]
    assert [str(path) for path in own_cache.iterdir()] == list(paths)
    ctypes.CDLL(paths.pop())


def test_code_the_compiler_refuses_is_an_error_with_its_words(own_cache, monkeypatch):
    """A working compiler that refuses the generated code is a defect, not a reason to be slow: no fallback, no file."""
    monkeypatch.setattr(compilation, "_source", lambda functions, driver: "int broken(")
    with pytest.raises(DynamicsError, match=r"failed on the generated code of the robot: .*error"):
        compiled_square()
    assert list(own_cache.iterdir()) == []


def test_damaged_library_is_removed_and_named(own_cache):
    """A file cut short by a full disk does not stay in the way of the next run."""
    own_cache.mkdir()
    damaged = own_cache / "damaged.so"
    damaged.write_bytes(b"\x7fELF cut short")
    with pytest.raises(DynamicsError, match=r"damaged\.so could not be loaded and was removed"):
        compilation.open_library(damaged)
    assert not damaged.exists()


@pytest.fixture
def forget():
    """What was found out about compilers is forgotten where a test says so, and after it."""

    def clear():
        for cached in (compilation.find_compiler, compilation.can_compile, robot_module._functions):
            cached.cache_clear()

    yield clear
    clear()


def test_compiler_may_have_arguments_of_its_own(loop, monkeypatch, forget):
    """CC="gcc -pipe" is a program with an argument, as make understands it."""
    plain = compilation.find_compiler()
    forget()
    monkeypatch.setenv("CC", f"{plain[0]} -pipe")
    assert compilation.find_compiler() == (plain[0], "-pipe")


@pytest.mark.parametrize(
    ("environment", "missed"),
    [
        ({"CC": "none-existing"}, "no C compiler found"),
        ({"CC": "{}/cc", "CMMSIM_CACHE": "{}/cache"}, "math.h"),
        ({"CMMSIM_CACHE": "{}/cc/no_folder"}, "CMMSIM_CACHE"),
    ],
)
def test_everything_works_without_a_compiler_after_one_warning(
    robot, states, loop, tmp_path, monkeypatch, forget, environment, missed
):
    """Compiler, its headers or the folder for its results taken away: robot and loop fall back to CasADi's virtual
    machine with the same numbers, and say so in exactly one line."""
    (tmp_path / "cc").write_text("#!/bin/sh\necho 'fatal error: math.h: No such file' >&2\nexit 1\n")
    (tmp_path / "cc").chmod(0o755)
    reference, settings, motion = loop.reference(10), loop.settings(), (states.pose, states.twist, states.twist_dot)
    compiled = robot.forward_dynamics(*motion), loop.run(reference, compiled=True)
    for name, value in environment.items():
        monkeypatch.setenv(name, value.format(tmp_path))
    forget()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fresh = robot_module.Robot(robot_file.read_robot_file("rss6"))
        accelerations = fresh.forward_dynamics(*motion)
        runs = [closed_loop.simulate(fresh, loop.parameters, reference, settings) for _ in range(2)]
        with pytest.raises(SimulationError, match="compiled=True"):
            closed_loop.simulate(fresh, loop.parameters, reference, settings, compiled=True)
    assert [warning.category for warning in caught] == [compilation.CompilerWarning]
    assert missed in str(caught[0].message)
    assert "\n" not in str(caught[0].message)
    np.testing.assert_allclose(accelerations, compiled[0], rtol=1e-10, atol=1e-12)
    assert_same(compiled[1], runs[1])
