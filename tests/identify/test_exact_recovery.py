"""Without noise, with an ideal sensor and the plant's own friction law, every base parameter comes back to 1e-6.

The plant steps as the model does, and the sensor states 1e-11 m and rad: poses have some 1e-16 of rounding. The weak
prior on the starting guess must then vanish beside the poses, and the test shows that it does. The scale is known by
the gain lp: a weighed platform would not do, because poses show its mass only in a sum with those of the links, which
the prior has to divide.
"""

import numpy as np
import pytest

from identify.estimation.base_parameters import base_parameters, structural_regressor
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import search
from identify.estimation.prior import StartingGuess, starting_guess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.loop_parameters import NAMES
from identify.record.recorded_run import recorded_run
from tests.identify.synthetic import quick, rss6, run_plant, silent, truth

STATED = 1e-11
OFF = 0.15
TIGHT = {
    "identification.cost_tolerance": 1e-14,
    "identification.parameter_tolerance": 1e-9,
    "identification.max_iterations": 60,
}


def found(plant_steps, model_steps):
    """Problem, solution and base parameters of a noise-free record, started 15 % off in every parameter but lp."""
    scenario = quick(**{"plant.steps_per_frame": plant_steps, "model.steps_per_frame": model_steps, **TIGHT})
    record, _ = run_plant(scenario, 0, np.zeros(6))
    record["measured_covariance"] = record["measured_covariance"] * 0 + STATED**2 * np.eye(6)
    signs = np.random.default_rng(1).choice([-1, 1], len(NAMES))
    gain = NAMES.index("joint_pid.lp")
    start = truth() * np.where(np.arange(len(NAMES)) == gain, 1.0, 1 + OFF * signs)
    guess = StartingGuess(start, starting_guess(rss6(), "initial", 1.0).std)
    anchor = ScaleAnchor("joint_gain", truth()[gain], 1e-9)
    problem = OutputErrorProblem((recorded_run(record, rss6(), scenario),), guess, anchor)
    driven = search(problem.driven_by_commands(), start, scenario, silent)
    solution = search(problem, driven.parameters, scenario, silent)
    return problem, solution, base_parameters(structural_regressor(rss6()))


def relative_errors(solution, base):
    """Of all groups, and of the gains."""
    groups = base.combinations @ solution.parameters[:64] / (base.combinations @ truth()[:64]) - 1
    return np.abs(groups), np.abs(solution.parameters[64:] / truth()[64:] - 1)


def test_every_base_parameter_and_gain_is_recovered_to_a_millionth():
    problem, solution, base = found(4, 4)
    groups, gains = relative_errors(solution, base)
    assert len(groups) == 37
    assert groups.max() < 1e-6, dict(zip(base.expressions(), groups, strict=True))
    assert gains.max() < 1e-6
    _, factor, _ = problem.linearise(solution.parameters)
    covariance = np.linalg.inv(factor.T @ factor)[:64, :64]
    after = np.einsum("gi,ij,gj->g", base.combinations, covariance, base.combinations)
    before = base.combinations**2 @ problem.guess.std[:64] ** 2
    assert (after / before).max() < 1e-9, "share of the starting guess in an estimate"


@pytest.mark.slow
def test_integration_limits_what_a_finer_plant_lets_recover():
    """Steps of a sixteenth and of a quarter of a frame differ by more than 1e-6: that, not the estimator, is then left.

    With both four times finer, the fourth-order integrator's difference is some hundred times smaller.
    """
    coarse, fine = (relative_errors(solution, base)[0] for _, solution, base in (found(16, 4), found(64, 16)))
    assert np.median(coarse) > 1e-6
    assert np.median(fine) < np.median(coarse) / 30
