"""What all tests share: no display, no growing cache, few threads, two processes, and results that
are kept.
"""

import json
import os
import platform
import re
import signal
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import typer.main

from identify.accuracy.figure import PROPERTY
from identify.files.atomic import write_text

pytest_plugins = ["pytester", "tests.browser"]

# Two workers with two BLAS threads each on two cores are slower than two with one.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("MPLBACKEND", "Agg")
# Tests name parts of their own as a user's files do, also in processes that they start.
os.environ.setdefault("CMMSIM_PLUGINS", "tests")

# A job that a shell began in the background ignores Ctrl-C, which tests send to themselves.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# A process has one command line. Each call of it in a test would build it anew, 25 ms of processor.
typer.main.get_command = cache(typer.main.get_command)


def pytest_addoption(parser: pytest.Parser) -> None:
    said = (
        "keep outcome, seconds and figures of each test that is run in a file, beside those of "
        "others in it"
    )
    parser.addoption("--keep-results", metavar="FILE", type=Path, help=said)


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--keep-results")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(KeptResults(path))


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes for the whole suite; none where files are named, to be watched, timed or
    stepped through.
    """
    return 2 if config.args_source == config.ArgsSource.TESTPATHS else 0


class KeptResults:
    """Keeps results of the long proofs and the speeds, which the README quotes: `sh .ci/thorough`
    writes them.

    An entry has the date, the outcome, the seconds, and the figures that a test gave to
    `record_property` or recorded with `accuracy`. At the end of a session its tests replace what
    the file says of them, but for those that were skipped, and those whose file is gone leave it.
    An entry that another machine or other versions made says so.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the time of each phase of a test; keep the first outcome that is no success, and the
        last figures.
        """
        test = re.sub(r"@\w+$", "", report.nodeid)  # the group of --dist loadgroup
        entry = self._found.setdefault(test, {"outcome": "passed", "seconds": 0.0, "figures": {}})
        entry["seconds"] = round(entry["seconds"] + report.duration, 2)
        if report.outcome != "passed" and entry["outcome"] != "failed":
            entry["outcome"] = report.outcome
        entry["figures"] = dict(map(_figure, report.user_properties))

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the file, whole or not at all, where tests were run."""
        if not self._found:
            return
        from identify.files.versions import versions

        engines = {
            one.name: one.version
            for one in metadata.distributions()
            if one.name in ("mujoco", "numba", "pin")
        }
        place = {
            "cores": os.cpu_count(),
            "machine": platform.machine(),
            "versions": versions() | engines,
        }
        old = json.loads(self._path.read_text(encoding="utf-8")) if self._path.exists() else {}
        elsewhere = {key: old[key] for key in old.keys() & place if old[key] != place[key]}
        tests = {
            test: elsewhere | entry
            for test, entry in old.get("tests", {}).items()
            if (session.config.rootpath / test.split("::")[0]).exists()
        }
        date = datetime.now(UTC).date().isoformat()
        for test, entry in self._found.items():
            if entry["outcome"] != "skipped" or test not in tests:
                tests[test] = {"date": date} | entry
        write_text(
            self._path,
            json.dumps(place | {"tests": dict(sorted(tests.items()))}, indent=2, ensure_ascii=False)
            + "\n",
        )


def _figure(recorded: tuple[str, Any]) -> tuple[str, Any]:
    name, value = recorded
    if name == PROPERTY:
        name, value = value["name"], value["value"]
    return name, float(f"{value:.4g}") if isinstance(value, float) else value
