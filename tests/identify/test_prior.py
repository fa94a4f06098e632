"""What is known of parameters beforehand, as the scenario states it."""

import numpy as np
import pytest

from identify.errors import ScenarioError
from identify.estimation.identification import identify
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.loop_parameters import NAMES
from identify.scenario import load_scenario, scenario_from_toml
from tests.identify.synthetic import quick, rss6, run_plant

GAIN = NAMES.index("joint_pid.lp")


def driven(**prior):
    known = {name.replace("_of_", "."): {"value": value, "std": std} for name, (value, std) in prior.items()}
    return quick(**{"identification.method": "command_driven", "identification.prior": known})


def test_a_known_gain_fixes_the_scale_as_the_anchor_of_that_name_does():
    """Two routes to the same knowledge; the anchor stands beside the starting guess, the prior in its place."""
    record, _ = run_plant(quick(), seed=1, duration_s=5.0)
    store_anchor(record, ScaleAnchor("joint_gain", 11.0, 0.02))
    by_anchor = identify(record, rss6(), driven())
    bare = record.copy()
    bare.attrs = {k: v for k, v in record.attrs.items() if not k.startswith("scale_anchor")}
    store_anchor(bare, ScaleAnchor("prior"))
    by_prior = identify(bare, rss6(), driven(joint_pid_of_lp=(11.0, 0.02)))
    assert by_prior.estimate[GAIN] == pytest.approx(11.0, abs=0.04)
    assert np.all(np.abs(by_prior.estimate - by_anchor.estimate) < 0.05 * by_anchor.std)
    assert np.allclose(by_prior.std, by_anchor.std, rtol=1e-3)


def test_of_what_no_motion_shows_the_prior_is_all_that_is_known():
    record, _ = run_plant(quick(), seed=1, duration_s=5.0)
    result = identify(record, rss6(), driven(link2_of_Izz=(3e-3, 1e-4)))
    k = NAMES.index("link2.Izz")
    assert result.estimate[k] == pytest.approx(3e-3, rel=1e-6)
    assert result.std[k] == pytest.approx(1e-4, rel=1e-6)
    assert not result.identifiable[k]


@pytest.mark.parametrize(
    ("name", "says"),
    [("joint_pid.li", "joint_pid.li is 0.0, must be"), ("platform.mass", "platform.mass = 0 kg is not")],
)
def test_what_no_model_has_cannot_be_expected_of_one(name, says):
    record, _ = run_plant(quick(), seed=1, duration_s=2.0)
    with pytest.raises(ScenarioError, match=rf"set 'initial', known beforehand: {name}\): {says}"):
        identify(record, rss6(), driven(**{name.replace(".", "_of_"): (0.0, 1.0)}))


def test_a_prior_survives_the_scenario_file_and_names_what_does_not_exist():
    scenario = driven(link2_of_Izz=(3e-3, 1e-4))
    assert scenario_from_toml(scenario.to_toml()) == scenario
    record, _ = run_plant(quick(), seed=1, duration_s=2.0)
    with pytest.raises(ScenarioError, match=r"no parameter 'link7.Izz'; valid: mass, Ixx"):
        identify(record, rss6(), driven(link7_of_Izz=(3e-3, 1e-4)))
    with pytest.raises(ScenarioError, match=r"prior.link2.Izz.std = 0.0"):
        driven(link2_of_Izz=(3e-3, 0.0))
    assert load_scenario("quick").identification.prior == {}
