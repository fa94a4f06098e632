"""Joint search for parameters and common errors, against differences of its cost."""

import numpy as np
import pytest

from identify.estimation.identification import asked_of, output_error_problem
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.estimation.simultaneous_search import JointProblem, JointRun
from tests.identify.record_forms import logged, record_from, scenario_of, true_parameters
from tests.identify.synthetic import run_plant


def test_the_linearisation_of_the_simultaneous_search_is_the_slope_of_its_cost():
    """The record has an unknown start and clock, and unknown centres of mass."""
    stds = {"timing.clock_offset_std_s": 0.02, "timing.clock_drift_std": 1e-4}
    telemetry = logged(*run_plant(scenario_of(), 0, duration_s=2.2))
    unknown = scenario_of(**stds, **{"model.centre_std": 0.02})
    record = record_from(telemetry, unknown)
    store_anchor(record, ScaleAnchor("platform_mass", true_parameters()[0], 0.005))
    asked = asked_of(record, None, None)
    problem = output_error_problem([record], asked.side, asked.settings).driven_by_commands()
    start = problem.guess.values
    (run,) = problem.with_common_errors(start).runs
    joint = JointProblem(problem, (JointRun.of(run, start),))
    errors = np.zeros(len(run.errors_had))
    assert len(errors) == 2 + 3 * 6 + len(run.common.body_std) > 20
    unknowns = np.concatenate([problem.bounds.coordinates(start), errors])
    scale = np.concatenate([problem.guess.std, np.ones(len(errors))])
    rng = np.random.default_rng(0)
    # all parameters stay above zero
    here = unknowns + 0.01 * rng.uniform(0.5, 1.0, len(unknowns)) * scale
    cost, factor, residual = joint.linearise(here)
    assert cost == pytest.approx(joint.cost(here), rel=1e-12)
    for place, close in [
        (0, 1e-6),  # a mass
        (60, 1e-4),  # a gain
        (67, 1e-3),  # the clock's offset: its mode is a difference
        (68, 1e-3),
        (69, 1e-4),  # the start: pose, rate and integral
        (72, 1e-4),
        (76, 1e-4),
        (81, 1e-3),
        (87, 1e-3),  # a centre of mass, whose effect is taken as linear
    ]:
        step = np.zeros(len(here))
        step[place] = 1e-4 * scale[place]
        slope = (joint.cost(here + step) - joint.cost(here - step)) / 2.0
        assert slope == pytest.approx(2.0 * residual @ factor @ step, rel=close)
