"""`identify.unseen_errors`, by which an own identification method is judged."""

import numpy as np
import pytest

import dynamics
import identify
from dynamics.closed_loop import LoopFailure, simulate
from dynamics.errors import DynamicsError
from identify.excitation.design import design_trajectories
from identify.loop_parameters import model_settings


@pytest.fixture(scope="module")
def scenario():
    return identify.load_scenario("quick").with_overrides({"validation.duration_s": 1.0, "excitation.candidates": 1})


@pytest.fixture(scope="module")
def robot():
    return dynamics.load_robot("rss6")


def test_the_true_parameters_leave_nothing_but_the_model_s_steps(scenario, robot):
    """Plant and model integrate the same law with other steps: below a hundredth of a micrometre and microradian."""
    errors = identify.unseen_errors(robot.parameter_sets["identified"].vector, robot, scenario)
    assert errors.shape == (2, 60, 6)
    assert 0 < np.abs(errors).max() < 1e-8


def test_wrong_parameters_err_as_two_runs_of_the_loop_differ(scenario, robot):
    """Against runs made here with both parameter sets on the same trajectory."""
    wrong = robot.parameter_sets["identified"].vector.copy()
    wrong[52:58] = 0.0
    errors = identify.unseen_errors(wrong, robot, scenario, seed=3)
    path = design_trajectories(robot, scenario, 3).validation[1]
    reference = path.reference(scenario.timing.frame_times(1.0))
    settings = model_settings(scenario)
    runs = [simulate(robot, p, reference, settings).pose for p in (wrong, robot.parameter_sets["identified"].vector)]
    assert np.abs(errors[1]).max() > 1e-5
    np.testing.assert_allclose(errors[1], runs[0] - runs[1], atol=1e-8)
    other = identify.unseen_errors(wrong, robot, scenario, seed=4)
    assert np.abs(other - errors).max() > 1e-5


def test_an_unstable_model_has_no_error(scenario, robot):
    unstable = robot.parameter_sets["initial"].vector.copy()
    unstable[64:67] = [0.1, 500.0, 0.0]
    reference = design_trajectories(robot, scenario, 0).validation[0].reference(scenario.timing.frame_times(1.0))
    with pytest.raises(LoopFailure):
        simulate(robot, unstable, reference, model_settings(scenario))
    assert np.isnan(identify.unseen_errors(unstable, robot, scenario)).all()


def test_what_are_no_parameters_is_refused_before_anything_runs(scenario, robot):
    for parameters in (np.zeros(64), np.full(67, np.nan)):
        with pytest.raises(DynamicsError, match=r"must have shape \(67,\), got \(64,\)|platform.mass = nan kg"):
            identify.unseen_errors(parameters, robot, scenario)
