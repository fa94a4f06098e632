"""Records made under other laws than the paper's servo, and what identification makes of them."""

import numpy as np
import pytest

from identify.errors import RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.experiment.plant import build_plant
from identify.experiment.run import excitation_run
from identify.experiment.truth import true_poses
from identify.record.law import recorded_law, takes_torques
from identify.studies.rows.sensor import DrawnSensor
from identify.validation.unseen import model_on_record
from tests.identify.synthetic import NAMES, SIGMA, quick, rss6, short_run, trajectory

FRICTION = [i for i, name in enumerate(NAMES) if name.startswith("joint") and "pid" not in name]
GAINS = [i for i, name in enumerate(NAMES) if name.startswith("joint_pid")]


def excited(law, seed=1, seconds=5.0, **more):
    """A scenario, its plant, and the record and truth of an excitation under a law that knows the starting model."""
    scenario = quick(**{"excitation.law": law, "excitation.duration_s": seconds}, **more)
    plant = build_plant(scenario, rss6())
    made = excitation_run(plant, DrawnSensor(np.diag(SIGMA**2)), trajectory(0), seed)
    return scenario, plant, made


@pytest.mark.slow
@pytest.mark.parametrize("observer", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_a_record_under_a_feedforward_is_identified_by_its_commands(observer):
    """The record says its law, the model gets its commands, and friction and gains are within their intervals."""
    scenario, plant, made = excited("feedforward", **{"control.observer": observer})
    assert (recorded_law(made.record), takes_torques(made.record)) == ("feedforward", False)
    said = made.record["command"].attrs
    assert (said["units"], said["long_name"]) == ("rad", "joint command of the law feedforward from this frame on")
    result = identify(made.record, rss6(), scenario)
    assert result.searches == ("command_driven",)
    assert np.abs((result.estimate - plant.parameters) / result.std)[FRICTION + GAINS].max() < 3.5
    assert result.identifiable[GAINS].all()
    after = model_on_record(rss6(), scenario, result.estimate, made.record)
    assert np.abs((after - true_poses(made.truth))[:, :3]).max() < 5e-6


def test_a_record_that_says_nothing_is_the_servos():
    record, _ = short_run()
    assert (recorded_law(record), takes_torques(record)) == ("pid", False)


@pytest.mark.parametrize(
    ("changes", "said"), [({"law": 3}, "attribute law is 3"), ({"torque_commands": 2}, "must be 0 or 1")]
)
def test_what_says_no_law_is_refused(changes, said):
    record = short_run()[0].assign_attrs(changes)
    with pytest.raises(RecordError, match=said):
        recorded_law(record), takes_torques(record)


def test_an_unknown_law_is_refused_with_the_valid_ones():
    with pytest.raises(ScenarioError, match="unknown law 'lqr'; valid: pid, feedforward, computed_torque"):
        quick(**{"excitation.law": "lqr"})
