"""Conditioning and correlation, on problems small enough to be worked out by hand and on records of known weakness."""

import numpy as np
import pytest

from identify.estimation.base_parameters import BaseParameters
from identify.estimation.covariance import correlation_matrix, strongest_pairs
from identify.estimation.identifiability import POOR, conditioning
from identify.estimation.identification import identify
from identify.loop_parameters import NAMES, StartingGuess
from identify.scenario import load_scenario
from tests.identify import synthetic


def three_unknowns(poses):
    """Conditioning of two dynamic parameters, one group each, and one gain, all of size one with a guess of 1 ± 1."""
    base = BaseParameters(("a", "b"), np.eye(2), (0, 1), (), (0.0, 1.0))
    return conditioning(poses, np.eye(3), base, StartingGuess(np.ones(3), np.ones(3)), np.ones(3))


def test_condition_numbers_are_those_worked_out_by_hand():
    """Poses that show a - b with weight 8 and a + b - 2 gain with weight 0.5, and nothing of the common factor."""
    first, second = np.array([1.0, -1.0, 0.0]) / np.sqrt(2), np.array([1.0, 1.0, -2.0]) / np.sqrt(6)
    found = three_unknowns(8 * np.outer(first, first) + 0.5 * np.outer(second, second))
    assert found.with_guess == pytest.approx(9.0)
    assert found.poses_alone == pytest.approx(16.0)
    assert (found.directions, found.unshown) == (2, 1)
    assert found.warnings() == ()


def test_what_the_poses_show_of_nothing_but_the_guess_is_a_warning():
    weak = np.array([1.0, 1.0, -2.0]) / np.sqrt(6)
    strong = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    found = three_unknowns(2 * np.outer(strong, strong) + 0.1 / POOR * np.outer(weak, weak))
    assert found.poor
    assert "1 of 2 directions" in found.warnings()[0]


def test_a_group_counts_as_one_unknown():
    """Two parameters that only act as a + 2 b: the information of the pair has rank one, that of the group is full."""
    row = np.array([1.0, 2.0, 0.0])
    gain = np.array([0.0, 0.0, 1.0])
    base = BaseParameters(("a", "b"), np.array([[1.0, 2.0]]), (0,), (), (0.0, 1.0))
    poses = 3.0 * np.outer(row - 3 * gain, row - 3 * gain)  # blind to a common factor of (a, b, gain) = (1, 1, 1)
    found = conditioning(poses, np.eye(3), base, StartingGuess(np.ones(3), np.ones(3)), np.ones(3))
    assert found.directions == 1
    assert found.poses_alone == pytest.approx(1.0)


def test_correlations_and_the_strongest_pairs():
    covariance = np.array([[4.0, 1.8, 0.0], [1.8, 1.0, -0.3], [0.0, -0.3, 9.0]])
    correlations = correlation_matrix(covariance)
    np.testing.assert_allclose(correlations, [[1, 0.9, 0], [0.9, 1, -0.1], [0, -0.1, 1]])
    pairs = strongest_pairs(correlations, ["a", "b", "c"], 2)
    assert [(p.first, p.second) for p in pairs] == [("a", "b"), ("b", "c")]
    assert [p.correlation for p in pairs] == pytest.approx([0.9, -0.1])


@pytest.mark.slow
def test_a_record_that_hardly_moves_is_called_poorly_conditioned():
    """A motion of 1 mm and 4 mrad leaves too little beside the sensor's noise; the scenario's motion does not warn."""
    scenario = synthetic.quick()
    plain = identify(synthetic.run_plant(scenario, seed=1)[0], synthetic.rss6(), scenario)
    assert plain.conditioning.poses_alone < POOR
    assert plain.warnings == ()
    little = identify(synthetic.run_plant(scenario, seed=1, size=0.1)[0], synthetic.rss6(), scenario)
    assert little.conditioning.poses_alone > POOR
    assert little.conditioning.unshown > plain.conditioning.unshown
    assert any("poorly conditioned" in warning for warning in little.warnings)
    assert little.groups.identifiable.sum() < plain.groups.identifiable.sum()


@pytest.mark.slow
def test_the_common_factor_ties_friction_and_gains_together():
    """What a weighed platform leaves of the common factor is larger than what is left of the ratio of two gains."""
    scenario = load_scenario("quick")
    result = identify(synthetic.run_plant(scenario, seed=1)[0], synthetic.rss6(), scenario)
    correlations = correlation_matrix(result.covariance)
    gains = [NAMES.index(f"joint_pid.{name}") for name in ("lp", "li")]
    assert correlations[gains[0], gains[1]] > 0.99
