"""What is known beside the poses: parameters that the scenario states, and the scale anchor of a record."""

import numpy as np
import pytest

from identify.errors import EstimationError, RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, read_anchor, store_anchor
from identify.loop_parameters import NAMES, index_of
from tests.identify.synthetic import quick, rss6, run_plant

GAIN = NAMES.index("joint_pid.lp")


@pytest.fixture(scope="module")
def record():
    return run_plant(quick(), seed=1, duration_s=5.0)[0]


def driven(**known):
    """A scenario with (value, std) of parameters by name, an underscore for its last dot."""
    prior = {".".join(name.rsplit("_", 1)): {"value": value, "std": std} for name, (value, std) in known.items()}
    return quick(**{"identification.method": "command_driven", "identification.prior": prior})


def anchored(record, anchor):
    """The record with another anchor."""
    bare = record.copy()
    bare.attrs = {name: value for name, value in record.attrs.items() if not name.startswith("scale_anchor")}
    store_anchor(bare, anchor)
    return bare


def test_a_known_gain_fixes_the_scale_as_the_anchor_of_that_name_does(record):
    """Two routes to the same knowledge; the anchor stands beside the starting guess, the prior in its place."""
    by_anchor = identify(anchored(record, ScaleAnchor("joint_gain", 11.0, 0.02)), rss6(), driven())
    by_prior = identify(anchored(record, ScaleAnchor("prior")), rss6(), driven(joint_pid_lp=(11.0, 0.02)))
    assert by_prior.estimate[GAIN] == pytest.approx(11.0, abs=0.04)
    assert np.all(np.abs(by_prior.estimate - by_anchor.estimate) < 0.05 * by_anchor.std)
    assert np.allclose(by_prior.std, by_anchor.std, rtol=1e-3)


def test_of_what_no_motion_shows_the_prior_is_all_that_is_known(record):
    result, k = identify(record, rss6(), driven(link2_Izz=(3e-3, 1e-4))), NAMES.index("link2.Izz")
    assert result.estimate[k] == pytest.approx(3e-3, rel=1e-6)
    assert result.std[k] == pytest.approx(1e-4, rel=1e-6)
    assert not result.identifiable[k]


def test_what_no_model_has_cannot_be_expected_of_one(record):
    with pytest.raises(ScenarioError, match=r"set 'initial', known beforehand: joint_pid.li\): joint_pid.li is 0.0"):
        identify(record, rss6(), driven(joint_pid_li=(0.0, 1.0)))
    with pytest.raises(ScenarioError, match=r"known beforehand: platform.mass\): platform.mass = 0 kg is not"):
        identify(record, rss6(), driven(platform_mass=(0.0, 1.0)))


def test_the_anchor_that_is_stored_is_read_and_a_weighing_is_one_equation_in_standard_deviations(record):
    for anchor in (ScaleAnchor("joint_gain", 10.5, 0.01), ScaleAnchor("payload")):
        assert read_anchor(anchored(record, anchor)) == anchor
    row, right = ScaleAnchor("platform_mass", 23.5, 0.005).row()
    assert np.flatnonzero(row) == [index_of("platform.mass")]
    assert row[0, index_of("platform.mass")] == pytest.approx(200)
    assert right[0] == pytest.approx(4700)
    assert ScaleAnchor("payload").row()[0].shape == (0, 67)


@pytest.mark.parametrize("bad", [np.float64(-3.0), 0.0, np.nan, np.inf, "23.5", True])
@pytest.mark.parametrize("attribute", ["scale_anchor_value", "scale_anchor_std"])
def test_an_impossible_anchor_is_refused_with_its_value_limit_and_unit(record, attribute, bad):
    shown = f"{float(bad)}" if isinstance(bad, float) else repr(bad)
    with pytest.raises(RecordError, match=rf"{attribute} is {shown}, must be a finite number > 0 in kg: .*form.mass"):
        read_anchor(record.assign_attrs({attribute: bad}))


def test_an_anchor_that_is_unknown_or_incomplete_and_what_is_no_robot_or_scenario_are_refused(record):
    with pytest.raises(RecordError, match=r"no scale anchor .*found 'guess'; valid anchors: platform_mass"):
        identify(record.assign_attrs(scale_anchor="guess"), rss6(), quick())
    half = anchored(record, ScaleAnchor("payload")).assign_attrs(scale_anchor="joint_gain", scale_anchor_value=1.0)
    with pytest.raises(RecordError, match=r"_std is None, must be .* in N m/rad: .*joint_gain measures joint_pid.lp"):
        read_anchor(half)
    with pytest.raises(EstimationError, match="None is no Robot: dynamics"):
        identify(record, None, quick())
    with pytest.raises(EstimationError, match="'quick' is no Scenario: identify"):
        identify(record, rss6(), "quick")
