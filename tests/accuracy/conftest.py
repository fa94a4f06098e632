"""What the tests of the plugin share: projects of one file, run by pytest."""

import textwrap
from pathlib import Path

import pytest

from identify.accuracy import recorder, saved  # noqa: F401  before any project: NumPy cannot be loaded twice

GUIDE = Path(__file__).parent / "guide"

QUICK = ("-p", "no:cacheprovider", "-p", "no:hypothesispytest")  # Hypothesis would be imported anew by each


@pytest.fixture
def project(pytester, monkeypatch):
    """(body of the tests, *options) -> the outcome of pytest on a file with these tests; as if not in a worker."""
    for name in ("PYTEST_XDIST_WORKER", "PYTEST_XDIST_WORKER_COUNT", "PYTEST_XDIST_TESTRUNUID"):
        monkeypatch.delenv(name, raising=False)

    def run(body, *options):
        head = "import numpy as np\nimport pytest\nRNG = np.random.default_rng(0)\n"
        pytester.makepyfile(test_mine=head + textwrap.dedent(body))
        return pytester.runpytest_inprocess(*QUICK, *options)

    return run


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """The files of the guide are as an outsider writes them: what marks of this project they deserve stands here."""
    for item in items:
        if item.path.parent == GUIDE:
            item.add_marker("slow")
            item.add_marker("rendering")
