"""Results of the long proofs, kept in a file that the README quotes: `sh .ci/thorough` writes it."""

import json
import os
import platform
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from identify.accuracy.figure import PROPERTY
from identify.files.atomic import write_text


class KeptResults:
    """Follows a session; at its end its tests replace what the file says of them, and those that are gone leave it.

    An entry has the date, the outcome, the seconds, and the figures that a test gave to `record_property` or recorded
    with `accuracy`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the time of each phase of a test; keep the first outcome that is no success, and the last figures."""
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

        kept = json.loads(self._path.read_text(encoding="utf-8"))["tests"] if self._path.exists() else {}
        kept = {test: entry for test, entry in kept.items() if (session.config.rootpath / test.split("::")[0]).exists()}
        date = datetime.now(UTC).date().isoformat()
        tests = kept | {test: {"date": date} | entry for test, entry in self._found.items()}
        content = {
            "cores": os.cpu_count(),
            "machine": platform.machine(),
            "versions": versions(),
            "tests": dict(sorted(tests.items())),
        }
        write_text(self._path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def _figure(recorded: tuple[str, Any]) -> tuple[str, Any]:
    name, value = recorded
    if name == PROPERTY:
        name, value = value["name"], value["value"]
    return name, float(f"{value:.4g}") if isinstance(value, float) else value
