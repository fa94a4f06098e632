"""The cache of compiled code: content as key, whole files only, no recompiling."""

import ctypes
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import casadi as ca
import pytest

from dynamics import compilation, load_robot
from dynamics.errors import DynamicsError

SQUARE = """
import casadi as ca
from dynamics import compilation, load_robot
x = ca.SX.sym("x")
print(compilation.load_library("square", load_robot("rss6").geometry, lambda g: [ca.Function("square", [x], [x * x])]))
"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")
    monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def _square(geometry):
    x = ca.SX.sym("x")
    return [ca.Function("square", [x], [x * x])]


def test_code_is_compiled_once_per_content(robot, own_cache):
    """The second request builds nothing; another geometry or name is another file."""
    build = Mock(side_effect=_square)
    first = compilation.load_library("square", robot.geometry, build)
    again = compilation.load_library("square", load_robot("rss6").geometry, build)
    assert first == again
    build.assert_called_once()
    assert float(ca.external("square", str(first))(3.0)) == 9.0
    shorter = replace(robot.geometry, crank_length=0.061)
    others = {compilation.load_library("square", shorter, build), compilation.load_library("cube", shorter, build)}
    assert len(others | {first}) == 3
    assert len(list(own_cache.iterdir())) == 3


def test_two_processes_that_compile_at_once_get_one_whole_library(own_cache):
    """Both end well with the same file, and no temporary file is left behind."""
    command, folder = [sys.executable, "-c", SQUARE], Path(__file__).parents[2]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) for _ in range(2)]
    paths = {process.communicate(timeout=60)[0].strip() for process in processes}
    assert [process.returncode for process in processes] == [0, 0]
    assert [str(path) for path in own_cache.iterdir()] == list(paths)
    ctypes.CDLL(paths.pop())


def test_code_the_compiler_refuses_is_an_error_with_its_words(robot, own_cache, monkeypatch):
    """A working compiler that refuses the generated code is a defect, not a reason to be slow: no fallback, no file."""
    monkeypatch.setattr(compilation, "_source", lambda functions, driver: "int broken(")
    with pytest.raises(DynamicsError, match=r"failed on the generated code of the robot: .*error"):
        compilation.load_library("square", robot.geometry, _square)
    assert list(own_cache.iterdir()) == []


def test_damaged_library_is_removed_and_named(own_cache):
    """A file cut short by a full disk does not stay in the way of the next run."""
    own_cache.mkdir()
    damaged = own_cache / "damaged.so"
    damaged.write_bytes(b"\x7fELF cut short")
    with pytest.raises(DynamicsError, match=r"damaged\.so could not be loaded and was removed"):
        compilation.open_library(damaged)
    assert not damaged.exists()


def test_compiler_may_have_arguments_of_its_own(monkeypatch):
    """CC="gcc -pipe" is a program with an argument, as make understands it."""
    plain = compilation.find_compiler()
    compilation.find_compiler.cache_clear()
    monkeypatch.setenv("CC", f"{plain[0]} -pipe")
    try:
        assert compilation.find_compiler() == (plain[0], "-pipe")
    finally:
        compilation.find_compiler.cache_clear()
