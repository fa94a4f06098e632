"""The common scale of parameters: its part in their errors, by sampling and by plain numbers."""

import numpy as np
import pytest

from identify.estimation.common_scale import deviations, found_errors
from identify.estimation.identifiability import scale_warnings
from identify.estimation.scale_anchor import ScaleAnchor
from identify.reporting.tables import common_scale_sentence
from identify.reporting.verdict import intervals_sentence


def test_the_scatter_of_ratios_to_a_gain_is_what_is_left_without_the_scale():
    """Parameters are drawn with a common factor of 4 % and errors of their own."""
    rng = np.random.default_rng(0)
    sizes = np.array([10.0, 0.1, 13.0])
    own = np.array([0.001, 0.005, 0.05])
    draws = sizes * (1 + 0.04 * rng.standard_normal((200_000, 1)))
    draws *= 1 + own * rng.standard_normal((200_000, 3))
    whole, without = deviations(sizes, np.cov(draws.T), 0)
    np.testing.assert_allclose(whole, np.hypot(0.04, own), rtol=0.01)
    np.testing.assert_allclose(without, [0, *np.hypot(0.001, own[1:])], rtol=0.02, atol=1e-9)


ENTRIES = {
    "joint_pid.lp": {"estimate": 9.25, "true": 10.0, "identifiable": True},
    "joint1.coulomb": {"estimate": 0.0915, "true": 0.1, "identifiable": True},
    "platform.mass": {"estimate": 13.2, "true": 13.2, "identifiable": True},
}
SCALE = {"gain": "joint_pid.lp", "std": 0.038, "shared": {"joint1.coulomb": 0.004}}


def test_one_sentence_tells_the_error_that_all_share_from_what_is_left():
    found = {"parameters": ENTRIES, "common_scale": SCALE}
    assert found_errors(found) == pytest.approx((-0.075, 1 - 0.915 / 0.925))
    said = common_scale_sentence(found)
    assert "a standard deviation of 3.8 %. 2 of the 3 identified parameters share its error" in said
    assert "which is -7.5 % here" in said
    assert "ratios to this gain are off by at most 1.1 %" in said
    unknown = {name: entry | {"true": None} for name, entry in ENTRIES.items()}
    said = common_scale_sentence({"parameters": unknown, "common_scale": SCALE})
    assert "ratios to this gain have standard deviations up to 0.4 %" in said
    assert common_scale_sentence({"parameters": ENTRIES, "common_scale": None}) == ""


def test_intervals_that_miss_the_truth_are_counted_with_those_that_share_the_scale():
    intervals = {
        "joint_pid.lp": [9.0, 9.5],
        "joint1.coulomb": [0.091, 0.092],
        "platform.mass": [13.19, 13.21],
    }
    entries = {name: one | {"interval": intervals[name]} for name, one in ENTRIES.items()}
    found = {"parameters": entries, "common_scale": SCALE}
    assert intervals_sentence(found) == (
        "1 of the 3 intervals of identified parameters contain the truth; 2 of the 2 others share "
        "the error of the common scale."
    )
    alone = found | {"common_scale": None}
    assert intervals_sentence(alone).endswith(
        "3 intervals of identified parameters contain the truth."
    )
    mass = {"parameters": {"platform.mass": entries["platform.mass"]}}
    assert (
        intervals_sentence(mass)
        == "All intervals of identified parameters contain the truth, 1 of 1."
    )
    unknown = {name: entry | {"true": None} for name, entry in entries.items()}
    assert intervals_sentence({"parameters": unknown}) == ""


def test_a_scale_that_is_badly_known_is_warned_of_whatever_makes_it_so():
    anchor = ScaleAnchor("platform_mass", 13.2, 0.005)
    (said,) = scale_warnings(anchor, "joint_pid.lp", 0.012, 0.09, 0.04)
    assert "fixes the scale of this robot only to 4.0%, the standard deviation of" in said
    assert scale_warnings(anchor, "joint_pid.lp", 0.003, 0.09, 0.011) == ()
