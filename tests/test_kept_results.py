"""Results that are kept say of each test when, how long and with what figures it ended, also from two processes."""

import json
import os
import platform

import pytest

TESTS = """
import pytest

@pytest.mark.xdist_group("one")
def test_proof(record_property, accuracy):
    record_property("held", 0.949123)
    accuracy.record("bias", 0.25, unit="um")

def test_bad(): assert False

@pytest.mark.skip
@pytest.mark.parametrize("name", ["new", "old"])
def test_skipped(name): pass
"""


@pytest.mark.parametrize("workers", ["0", pytest.param("1", marks=pytest.mark.slow)])
def test_each_test_of_a_session_replaces_its_entry_and_leaves_those_of_others(pytester, monkeypatch, workers):
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    pytester.makeconftest("from tests.conftest import pytest_addoption, pytest_configure")
    pytester.makepyfile(test_mine=TESTS, test_other="")
    old = {"date": "2020-01-01", "outcome": "passed", "seconds": 1.0, "figures": {}}
    names = ("test_other.py::a", "gone.py::b", "test_mine.py::test_bad", "test_mine.py::test_skipped[old]")
    kept = pytester.path / "kept.json"
    kept.write_text(json.dumps({"cores": os.cpu_count(), "machine": "abacus", "tests": dict.fromkeys(names, old)}))
    pytester.runpytest_inprocess("-n", workers, "--dist", "loadgroup", "-p", "no:cacheprovider", "--keep-results", kept)
    content = json.loads(kept.read_text())
    tests = content["tests"]
    assert {name: entry["outcome"] for name, entry in tests.items()} == {
        "test_mine.py::test_bad": "failed",
        "test_mine.py::test_proof": "passed",
        "test_mine.py::test_skipped[new]": "skipped",
        "test_mine.py::test_skipped[old]": "passed",
        "test_other.py::a": "passed",
    }
    assert tests["test_other.py::a"] == tests["test_mine.py::test_skipped[old]"] == {"machine": "abacus"} | old
    assert tests["test_mine.py::test_proof"]["figures"] == {"held": 0.9491, "bias": 0.25}
    assert tests["test_mine.py::test_bad"]["date"] > "2020-01-01"
    assert {"cmmsim", "numpy", "pin", "python"} <= set(content["versions"])
    assert content["machine"] == platform.machine()
