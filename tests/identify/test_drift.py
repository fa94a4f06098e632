"""Cameras that drift during an experiment: what the run's watch says reaches record, result and
warnings.
"""

import pytest

from cmmsim.errors import CmmError
from cmmsim.teaching import exactly_taught
from identify.errors import RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.experiment.run import excitation_run
from identify.record.conditions import DRIFT, drift_warnings, read_finding, store_finding
from identify.setup import Setup
from tests.identify.synthetic import quick, rss6, run_plant, trajectory

DRIFT_KEY = "rig.drift"


def recorded(**changes):
    """Record and truth of 1.5 s through images, with cameras that are taught without error."""
    scenario = quick(**{"renderer": "analytic", "excitation.duration_s": 1.5} | changes)
    setup = Setup(scenario, loaded=rss6())
    plan = setup.sensor_plan
    sensor = plan.make(rss6(), 0, exactly_taught(plan.file))
    return excitation_run(setup.plant, sensor, trajectory(0), scenario.excitation, 0).record


@pytest.mark.thorough
def test_a_run_with_a_drift_says_when_and_how_and_one_without_says_nothing():
    finding = read_finding(recorded(**{DRIFT_KEY: {"right.cx_px": 0.3}}))
    assert 0.0 < finding["noticed_s"] < 1.0
    assert finding["movements"][0]["name"] == "right.cx_px"
    assert finding["movements"][0]["amount"] == pytest.approx(0.3, rel=0.2)
    assert finding["warning"].startswith("the cameras moved: noticed after 0.")
    still = recorded()
    assert read_finding(still)["noticed_s"] is None
    assert drift_warnings([still]) == ()
    assert read_finding(recorded(**{"rig.watch": "none"})) is None


@pytest.mark.slow
def test_an_identification_begins_its_warnings_with_the_cameras():
    record, _ = run_plant(quick(), 0, duration_s=5.0)
    store_finding(record, {"warning": "the cameras moved"})
    assert identify(record, rss6(), quick()).warnings[0] == "the cameras moved"


@pytest.mark.parametrize(
    ("drift", "words"),
    [
        ({"right.centre": 0.1}, "a rig has no parameter 'right.centre'"),
        ({"left.cy_px": 1e3}, "a drift of left.cy_px by 1000 takes sticker"),
    ],
)
def test_a_drift_that_no_run_can_have_is_refused_before_anything_is_taught(drift, words):
    scenario = quick(**{"renderer": "analytic", DRIFT_KEY: drift})
    with pytest.raises(CmmError, match=words):
        Setup(scenario).sensor_plan.make(rss6(), 0)
    with pytest.raises(ScenarioError, match=r"rig\.watch"):
        quick(**{"rig.watch": "everything"})
    with pytest.raises(ScenarioError, match="a name with a dot must be in double quotes"):
        quick(**{DRIFT_KEY: {"right": {"cx_px": 0.1}}})


@pytest.mark.parametrize("text", ["{", "[]", '{"noticed_s": 1.0}', "3"])
def test_a_finding_that_is_none_is_refused_in_one_line(text):
    record, _ = run_plant(quick(), 0, duration_s=1.0)
    record.attrs[DRIFT] = text
    with pytest.raises(RecordError, match="drift_watch of the record is not a finding"):
        read_finding(record)
