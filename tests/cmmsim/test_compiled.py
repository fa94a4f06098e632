"""Where compiled kernels are kept, and when they are compiled anew."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

import cmmsim

PROBE = (
    "import numpy as np; from cmmsim.geometry.disc_image import coverage as c;"
    "print(c(np.full((1, 2), 5.2), np.eye(2)[None] * 3.0, 12)[0].sum())"
)


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
    before = run_copy(copied, {})

    def kept():
        return {p: p.stat().st_mtime_ns for p in (copied / "cmmsim").rglob("*.nbi")}

    first = kept()
    assert first
    assert run_copy(copied, {}) == before
    assert kept() == first
    # any kernel counts, whether called or not
    callee = copied / "cmmsim" / "detection" / "fit_kernels.py"
    callee.write_text(callee.read_text() + "\n")
    # nor is an index read that names a module which is gone
    for index in first:
        index.write_bytes(pickle.dumps(numba.__version__) + b"cgone_kernels\nmeasure\n.")
    assert run_copy(copied, {}) == before
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
        assert run_copy(copied, users) == pytest.approx(9.0 * np.pi)
    assert list((tmp_path / "home").rglob("rim_kernels*.nbi"))
