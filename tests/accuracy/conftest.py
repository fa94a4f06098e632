"""What the tests of the plugin share: projects of one file, run by pytest."""

import textwrap

import pytest

QUICK = ("-p", "no:cacheprovider", "-p", "no:hypothesispytest")  # Hypothesis would be imported anew by each


@pytest.fixture
def project(pytester):
    """(body of the tests, *options) -> the outcome of pytest on a file with these tests."""

    def run(body, *options):
        head = "import numpy as np\nimport pytest\nRNG = np.random.default_rng(0)\n"
        pytester.makepyfile(test_mine=head + textwrap.dedent(body))
        return pytester.runpytest_inprocess(*QUICK, *options)

    return run
