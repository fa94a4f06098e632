"""The comparison of estimators: the examination, the table's rows, and who wins."""

import numpy as np
import pytest

from identify.errors import EstimationError, ScenarioError
from identify.estimators.evidence import Estimate, Evidence
from identify.estimators.output_error_routes import known_pid
from identify.estimators.registry import ESTIMATORS, Estimator, choose
from identify.progress import SilentProgress
from identify.validation.estimator_comparison import START, compare, estimators_figure, examination
from tests.identify.estimator_evidence import evidence, unseen
from tests.identify.synthetic import truth


@pytest.fixture(scope="module")
def seen():
    return evidence(1)


@pytest.fixture(scope="module")
def asked(seen):
    return examination(seen, truth(), unseen())


def score(seen, asked, parameters):
    fixed = Estimator("fixed", "nothing", lambda given: Estimate(parameters, None, 0.0, 0, 0))
    return compare(seen, asked, {"fixed": fixed}, SilentProgress())[1]


def test_the_truth_has_no_parameter_distance_and_only_the_integrators_pose_distance(seen, asked):
    """Plant and model integrate with other steps: that is all that the true parameters leave."""
    exact = score(seen, asked, truth())
    assert exact.group_distance == 0
    assert exact.gain_distance == 0
    assert exact.position_um < 0.05
    assert exact.orientation_urad < 0.5


def test_distances_are_relative_and_of_what_the_record_shows(seen, asked):
    """3 % on everything is 3 % of every combination, and what no motion shows does not count."""
    assert 20 <= len(asked.combinations) <= 37
    off = score(seen, asked, 1.03 * truth())
    assert off.group_distance == pytest.approx(0.03, rel=1e-9)
    assert off.group_median == pytest.approx(0.03, rel=1e-9)
    assert off.gain_distance == pytest.approx(0.03, rel=1e-9)
    hidden = truth().copy()
    hidden[[5, 6]] *= 5.0  # Ixx and Iyy of the first crank do no work
    assert score(seen, asked, hidden).group_distance < 1e-12


def test_an_estimator_that_fails_has_its_reason_in_the_table(seen, asked):
    """No torque channel, no known gains: the other rows stand, and the figure can be drawn."""
    poses_only = Evidence(seen.problem, seen.scenario)
    chosen = choose(["torque_ls", "known_pid", "warm_start"])
    rows = {row.name: row for row in compare(poses_only, asked, chosen, SilentProgress())}
    assert "needs a measured torque" in rows["torque_ls"].note
    assert "gains of the joint PID are not known" in rows["known_pid"].note
    assert np.isnan(rows["torque_ls"].position_um)
    assert rows["warm_start"].position_um < rows[START].position_um / 5
    assert len(estimators_figure(list(rows.values())).axes) == 4


def test_a_model_that_does_not_run_has_no_pose_distance(seen, asked):
    wild = truth().copy()
    wild[64:] *= 1e4
    assert np.isnan(score(seen, asked, wild).position_um)


def test_parameters_of_no_model_have_no_pose_distance(seen, asked):
    """A regression may end at a gain of zero, where it is bounded: its row stands without this distance."""
    stopped = truth().copy()
    stopped[65] = 0.0
    found = score(seen, asked, stopped)
    assert np.isnan(found.position_um)
    assert found.gain_distance == pytest.approx(1 / np.sqrt(3))


def test_names_and_examinations_that_do_not_exist_are_refused(seen):
    with pytest.raises(ScenarioError, match="unknown estimator 'best'; valid: closed_loop, command_driven"):
        choose(["warm_start", "best"])
    assert list(choose(["torque_ls", "closed_loop"])) == ["closed_loop", "torque_ls"]
    assert choose(None) == ESTIMATORS
    with pytest.raises(EstimationError, match="no unseen trajectory"):
        examination(seen, truth(), [])


@pytest.mark.slow
def test_known_gains_stay_and_anchor_the_rest(seen):
    found = known_pid(seen)
    assert np.allclose(found.parameters[64:], truth()[64:], rtol=1e-5)
    friction = slice(52, 64)
    assert np.all(np.abs(found.parameters - truth())[friction] < 4 * found.std[friction])


@pytest.mark.slow
def test_output_error_beats_the_linear_estimators_on_unseen_poses(seen, asked):
    """All nine on one record: what is fitted in the loop's own output predicts it best, at the price of time."""
    rows = {row.name: row for row in compare(seen, asked, ESTIMATORS, SilentProgress())}
    assert all(np.isfinite(row.position_um) for row in rows.values()), {n: row.note for n, row in rows.items()}
    best = rows["command_driven"]
    linear = [name for name in ESTIMATORS if name not in ("closed_loop", "command_driven", "known_pid")]
    assert len(linear) == 6
    for name in linear:
        assert best.position_um < rows[name].position_um / 2, name
        assert best.orientation_urad < rows[name].orientation_urad / 2, name
        assert best.group_distance < rows[name].group_distance * 1.2, name
    assert best.evaluations > rows["torque_iv"].evaluations > rows["torque_wls"].evaluations == 0
    assert all(row.position_um < rows[START].position_um / 5 for name, row in rows.items() if name != START)
