"""What the tests of the plugin share: projects of one file, run by pytest, and four figures of
one."""

import textwrap

import numpy.fft  # noqa: F401  before any project: NumPy cannot be loaded twice
import pytest
import scipy.special  # noqa: F401

import cmmsim
import identify.pipeline  # noqa: F401

collect_ignore = [
    "guide"
]  # an outsider's files: test_outside_project.py runs them as an outsider would

FIGURES = """
def test_sensor(accuracy):
    accuracy.record("bias", 0.002, unit="px", limit=0.003)
    accuracy.record("seen", 0.98, limit=0.95, better="higher")

@pytest.mark.parametrize("method", ["planes", "registration"])
def test_pose(accuracy, method):
    accuracy.sample("pose", 10 + np.random.default_rng(len(method)).normal(0, 1, 50), unit="um")
"""
SAVE, COMPARE = ("--accuracy-save", "before"), ("--accuracy-compare", "before")
QUICK = (
    "-p",
    "no:cacheprovider",
    "-p",
    "no:hypothesispytest",
)  # Hypothesis would be imported anew by each


def recording(calls):
    """Body of tests that call `accuracy` once each."""
    return "".join(f"def test_{n}(accuracy): accuracy.{call}\n" for n, call in enumerate(calls))


@pytest.fixture(scope="session", autouse=True)
def loaded():
    """What a sensor loads when it measures: pytester forgets what a project was first to import,
    and neither numba nor OpenGL can be loaded twice."""
    sensor = cmmsim.load_sensor("ctrack780", seed=0)
    sensor.measure(sensor.home)


@pytest.fixture
def project(pytester, monkeypatch):
    """(body of the tests, *options) -> the outcome of pytest on a file with these tests; as if not
    in a worker.
    """
    for name in ("PYTEST_XDIST_WORKER", "PYTEST_XDIST_WORKER_COUNT", "PYTEST_XDIST_TESTRUNUID"):
        monkeypatch.delenv(name, raising=False)

    def run(body, *options):
        head = "import numpy as np\nimport pytest\nRNG = np.random.default_rng(0)\n"
        pytester.makepyfile(test_mine=head + textwrap.dedent(body))
        return pytester.runpytest_inprocess(*QUICK, *options)

    return run


@pytest.fixture
def saved(pytester):
    """The file of figures saved as `before`."""
    return pytester.path / ".accuracy" / "before.json"
