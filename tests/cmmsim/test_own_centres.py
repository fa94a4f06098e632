"""Faults of a user's own detector, which are told from the centres in windows of drawn spots."""

import re

import numpy as np
import pytest

from cmmsim.detection.own_centres import likely_fault

COUNT, SIZE = 24, 16
LAST = SIZE - 1


@pytest.fixture(scope="module")
def drawn():
    """Windows of bright spots with noise, their corners, and the true centres in the window."""
    rng = np.random.default_rng(3)
    corners = rng.integers(100, 1400, (COUNT, 2))
    own = LAST / 2 + rng.uniform(-0.6, 0.6, (COUNT, 2))
    ticks = np.arange(SIZE)
    far = np.hypot(ticks - own[:, :1, None], ticks[:, None] - own[:, 1:, None])
    windows = 16 + 180 / (1 + np.exp(4 * (far - 3.8))) + rng.normal(0, 4, far.shape)
    return windows, corners, own


FAULTS = {
    "they are in px of the windows; add `corners`": lambda own, corners: own,
    "they have x and y exchanged": lambda own, corners: (corners + own)[:, ::-1],
    "they have x and y exchanged within the windows": lambda own, corners: corners + own[:, ::-1],
    "they are in px of the windows with x and y exchanged": lambda own, corners: own[:, ::-1],
    "they are the sums of a centre (x, y) in the window and of corners in the order (y, x)": (
        lambda own, corners: corners[:, ::-1] + own
    ),
    "their x counts from the right edge of the window": (
        lambda own, corners: corners + [LAST, 0] + own * [-1, 1]
    ),
    "their y counts from the lower edge of the window": (
        lambda own, corners: corners + [0, LAST] + own * [1, -1]
    ),
    "the corners are added twice": lambda own, corners: own + 2 * corners,
    f"{COUNT} of {COUNT} centres lie outside of their windows": (
        lambda own, corners: np.random.default_rng(0).uniform(0, 90, own.shape)
    ),
}


@pytest.mark.parametrize("said", FAULTS)
def test_each_fault_is_told_by_its_name(said, drawn):
    windows, corners, own = drawn
    assert likely_fault(windows, corners, FAULTS[said](own, corners)) == (said, True)


def test_an_offset_is_told_with_its_size_and_good_or_few_centres_are_no_fault(drawn):
    windows, corners, own = drawn
    noise = np.random.default_rng(1).normal(0, 0.03, own.shape)
    said, certain = likely_fault(windows, corners, corners + own + noise + [0.5, 0.5])
    assert not certain
    offset = re.fullmatch(r"all centres are off by about \((.*), (.*)\) px", said)
    assert [float(one) for one in offset.groups()] == pytest.approx([0.5, 0.5], abs=0.05)
    assert likely_fault(windows, corners, corners + own + noise) == ("", False)
    assert likely_fault(windows[:4], corners[:4], own[:4]) == ("", False)
    # A poor detector is no faulty one.
    poor = np.random.default_rng(2).normal(0, 0.5, own.shape)
    assert likely_fault(windows, corners, corners + own + poor) == ("", False)
