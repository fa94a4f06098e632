"""Where compiled kernels are kept, and when they are compiled anew."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import cmmsim

# A small kernel, and one of another file that it calls: they are compiled in half a second.
PROBE = (
    "import numpy as np; from cmmsim.geometry.pose_fit_kernels import turn_arm;"
    "arm, gap = np.zeros((2, 3));"
    "turn_arm(np.eye(3, 4), np.array([1.0, 2.0, 4.0]), np.zeros(3), arm, gap);"
    "print(arm.sum())"
)
PROBED = 7.0


def run_copy(folder, environment):
    run = {
        "cwd": folder,
        "env": os.environ | environment,
        "check": True,
        "capture_output": True,
        "text": True,
    }
    return float(subprocess.run([sys.executable, "-c", PROBE], **run).stdout)


@pytest.fixture
def copied(tmp_path):
    """A folder with a copy of the package, without any compiled kernel."""
    install, no_cache = tmp_path / "install", shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(cmmsim.__file__).parent, install / "cmmsim", ignore=no_cache)
    return install


@pytest.mark.slow
def test_kernel_is_compiled_anew_when_one_that_it_calls_changes(copied):
    assert run_copy(copied, {}) == PROBED

    def kept():
        return {p: p.stat().st_mtime_ns for p in (copied / "cmmsim").rglob("*.nbi")}

    first = kept()
    assert {path.name.partition(".")[0] for path in first} == {
        "pose_fit_kernels",
        "transform_kernels",
    }
    assert run_copy(copied, {}) == PROBED
    assert kept() == first
    # any kernel counts, whether called or not
    callee = copied / "cmmsim" / "detection" / "ellipse_fit_kernels.py"
    callee.write_text(callee.read_text() + "\n")
    # nor is an index read that names a module which is gone
    for index in first:
        index.write_bytes(pickle.dumps(numba.__version__) + b"cgone_kernels\nmeasure\n.")
    assert run_copy(copied, {}) == PROBED
    assert kept() != first


@pytest.mark.slow
def test_kernels_compile_where_the_package_cannot_be_written(copied, tmp_path):
    """The cache goes to the user's folder; without one they are compiled in every process."""
    if os.geteuid() == 0:
        # root may write anywhere, but not into a file
        (copied / "cmmsim" / "geometry" / "__pycache__").write_text("")
    else:
        (copied / "cmmsim" / "geometry").chmod(0o555)
    (tmp_path / "nowhere").write_text("")
    for place in (tmp_path / "home", tmp_path / "nowhere"):
        users = {"HOME": str(place), "XDG_CACHE_HOME": str(place)}
        assert run_copy(copied, users) == PROBED
    assert list((tmp_path / "home").rglob("pose_fit_kernels*.nbi"))
