"""What all tests share: no display, no growing cache, few threads, two processes, and results that are kept."""

import os
import signal
from pathlib import Path

import pytest

from tests.kept_results import KeptResults

# Two workers with two BLAS threads each on two cores are slower than two with one.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("MPLBACKEND", "Agg")

# A job that a shell began in the background ignores Ctrl-C, which tests send to themselves.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    said = "keep outcome, seconds and figures of each test that is run in a file, beside those of others in it"
    parser.addoption("--keep-results", metavar="FILE", type=Path, help=said)


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--keep-results")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(KeptResults(path))


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes for the whole suite; none where files are named, to be watched, timed or stepped through."""
    return 2 if config.args_source == config.ArgsSource.TESTPATHS else 0
