"""`identify.unseen_errors`, by which an own identification method is judged."""

import numpy as np
import pytest

import identify
from dynamics.closed_loop import (
    LoopFailure,
    simulate_servo,
)
from dynamics.errors import DynamicsError
from identify.setup import Setup
from tests.identify.synthetic import quick, rss6, side_of, truth

SCENARIO = quick(**{"validation.duration_s": 1.0, "excitation.candidates": 1})


def unseen_errors(parameters, seed=0):
    return identify.unseen_errors(parameters, rss6(), SCENARIO, seed=seed)


def simulated(parameters, run, seed=0):
    """Poses of the loop with these parameters on an unseen trajectory."""
    path = Setup(SCENARIO, seed).trajectories.validation[run]
    return simulate_servo(
        rss6(),
        parameters,
        path.reference(SCENARIO.timing.frame_times(1.0)),
        side_of(SCENARIO).settings,
    ).pose


def test_the_true_parameters_leave_nothing_but_the_models_steps():
    """Plant and model integrate the same law with other steps: below a hundredth of a micrometre
    and microradian.
    """
    errors = unseen_errors(truth())
    assert errors.shape == (2, 60, 6)
    assert 0 < np.abs(errors).max() < 1e-8


@pytest.mark.slow
def test_wrong_parameters_err_as_two_runs_of_the_loop_differ():
    """Against runs made here with both parameter sets on the same trajectory."""
    wrong = truth().copy()
    wrong[52:58] = 0.0
    errors = unseen_errors(wrong, seed=3)
    assert np.abs(errors[1]).max() > 1e-5
    np.testing.assert_allclose(
        errors[1], simulated(wrong, 1, seed=3) - simulated(truth(), 1, seed=3), atol=1e-8
    )
    assert np.abs(unseen_errors(wrong, seed=4) - errors).max() > 1e-5


def test_an_unstable_model_has_no_error_and_what_are_no_parameters_is_refused():
    unstable = rss6().parameter_sets["guess"].vector.copy()
    unstable[64:67] = [0.1, 500.0, 0.0]
    with pytest.raises(LoopFailure):
        simulated(unstable, 0)
    assert np.isnan(unseen_errors(unstable)).all()
    for parameters in (np.zeros(64), np.full(67, np.nan)):
        with pytest.raises(
            DynamicsError, match=r"must have shape \(67,\), got \(64,\)|platform.mass = nan kg"
        ):
            unseen_errors(parameters)
