"""Records made under other laws than the paper's servo, and what identification makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from identify.errors import RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.experiment.run import excitation_run
from identify.experiment.truth import true_poses
from identify.model.from_record import identified_model
from identify.record.conditions import recorded_law, takes_torques
from identify.studies.rows.row_sensor import DrawnSensor
from identify.validation.unseen import model_on_record
from tests.identify.synthetic import (
    NAMES,
    SIGMA,
    build_plant,
    quick,
    rss6,
    short_run,
    side_of,
    trajectory,
)

FRICTION = [i for i, name in enumerate(NAMES) if name.startswith("joint") and "pid" not in name]
GAINS = [i for i, name in enumerate(NAMES) if name.startswith("joint_pid")]


def excited(law, seed=1, seconds=5.0, **more):
    """A scenario, its plant, and the record and truth of an excitation under a law that knows the
    starting model.
    """
    scenario = quick(**{"excitation.law": law, "excitation.duration_s": seconds}, **more)
    plant = build_plant(scenario, rss6())
    made = excitation_run(
        plant, DrawnSensor(np.diag(SIGMA**2)), trajectory(0), scenario.excitation, seed
    )
    return scenario, plant, made


@pytest.mark.slow
@pytest.mark.parametrize("observer", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_a_record_under_a_feedforward_is_identified_by_its_commands(observer):
    """The record says its law, the model gets its commands, and friction and gains are within their
    intervals.
    """
    scenario, plant, made = excited("feedforward", **{"control.observer": observer})
    assert (recorded_law(made.record), takes_torques(made.record)) == ("feedforward", False)
    said = made.record["command"].attrs
    assert (said["units"], said["long_name"]) == (
        "rad",
        "joint command of the law feedforward from this frame on",
    )
    result = identify(made.record, rss6(), scenario)
    assert result.searches == ("command_driven",)
    assert np.abs((result.estimate - plant.parameters) / result.std)[FRICTION + GAINS].max() < 3.5
    assert result.identifiable[GAINS].all()
    after = model_on_record(side_of(scenario), result.estimate, made.record)
    assert np.abs((after - true_poses(made.truth))[:, :3]).max() < 5e-6


@pytest.mark.slow
def test_a_record_of_torques_shows_base_parameters_without_the_gains():
    """Under computed torque with the starting model: friction and base parameters within their
    intervals, residuals that are white, and gains that nobody claims to know."""
    scenario, plant, made = excited("computed_torque", seconds=4.0)
    assert takes_torques(made.record)
    assert made.record["command"].attrs["units"] == "N m"
    result, true = identify(made.record, rss6(), scenario), plant.parameters
    assert np.abs((result.estimate - true) / result.std)[FRICTION].max() < 3.5
    groups = result.groups
    off = ((groups.estimate - groups.combinations @ true[:64]) / groups.std)[groups.identifiable]
    assert len(off) > 30
    assert np.abs(off).max() < 3.5
    assert result.whiteness.p_value > 0.01
    assert not result.identifiable[GAINS].any()
    np.testing.assert_allclose(result.estimate[GAINS], result.initial[GAINS], rtol=1e-9)
    assert not result.to_dict()["drive"]["in_loop"]
    assert any("the commands are torques" in warning for warning in result.warnings)


@pytest.mark.slow
def test_spans_of_torques_find_their_starts_from_filtered_rates_that_are_far_off():
    """By ten times what the filter makes of noise, so that joints stick and slip otherwise."""
    scenario, plant, made = excited("computed_torque", seconds=4.0)
    run = identified_model(made.record, side_of(scenario))
    off = (
        2e-3
        * np.array([1, 1, 1, 6, 6, 6])
        * np.random.default_rng(0).choice([-1, 1], (len(run.starts), 6))
    )
    far = replace(run, starts=run.starts + np.hstack([0 * off, 5 * off]))
    assert np.sqrt(np.mean(far.residuals(plant.parameters) ** 2)) < 1.2


@pytest.mark.thorough
def test_base_parameters_of_torques_err_as_much_as_their_intervals_say():
    """Over twelve seeds: the mean squared normalised error of friction and groups is one, but for
    chance.
    """
    squares = []
    for seed in range(12):
        scenario, plant, made = excited("computed_torque", seed=seed, seconds=4.0)
        result, true = identify(made.record, rss6(), scenario), plant.parameters
        groups = result.groups
        off = ((groups.estimate - groups.combinations @ true[:64]) / groups.std)[
            groups.identifiable
        ]
        friction = ((result.estimate - true) / result.std)[FRICTION]
        squares.append([np.mean(off**2), np.mean(friction**2)])
    assert (np.mean(squares, axis=0) < 1.4).all(), squares


@pytest.mark.slow
def test_derivatives_of_fitted_spans_are_finite_differences():
    """Of the poses, by the platform's mass and the friction of a joint: each span's start
    follows."""
    scenario, plant, made = excited("computed_torque", seconds=2.0)
    run, values = identified_model(made.record, side_of(scenario)), plant.parameters
    slopes = run.simulate(values).pose_sensitivity
    for index, size in ((0, 1e-3), (FRICTION[1], 1e-5), (FRICTION[7], 1e-5)):
        ends = [
            run.simulate(values + sign * size * np.eye(len(values))[index]).pose for sign in (1, -1)
        ]
        numeric = (ends[0] - ends[1]) / (2 * size)
        own = slopes[:, :, index]
        assert np.median(np.abs(own - numeric)) < 0.02 * np.sqrt(np.mean(numeric**2))


def test_a_record_that_says_nothing_is_the_servos():
    record, _ = short_run()
    assert (recorded_law(record), takes_torques(record)) == ("pid", False)


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"law": 3}, "attribute law is 3"), ({"torque_commands": 2}, "must be 0 or 1")],
)
def test_what_says_no_law_is_refused(changes, said):
    record = short_run()[0].assign_attrs(changes)
    with pytest.raises(RecordError, match=said):
        recorded_law(record), takes_torques(record)


def test_an_unknown_law_is_refused_with_the_valid_ones():
    with pytest.raises(
        ScenarioError, match="unknown law 'lqr'; valid: pid, feedforward, computed_torque"
    ):
        quick(**{"excitation.law": "lqr"})
