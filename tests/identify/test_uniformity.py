"""Simulation-based calibration: truths follow the prior, and right distributions pass the tests
that wrong ones fail.
"""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstest, truncnorm

from dynamics import DynamicsError, load_robot
from identify.errors import StudyError
from identify.estimation import output_error_search
from identify.estimation.bounds import parameter_bounds
from identify.estimation.intervals import bounded_estimate
from identify.estimation.prior import starting_guess
from identify.estimation.scale_anchor import ScaleAnchor, store_anchor
from identify.studies.rows.calibrated import (
    CalibrationOptions,
    compute,
    drawn_truth,
    log_of_moving_robot,
    moving_frames,
)
from identify.studies.rows.kind import PROBABILITY
from identify.studies.uniformity import (
    BAND,
    judge_uniformity,
    simultaneous_band,
    uniformity_figure,
)
from tests.identify.record_forms import (
    LATENCY_S,
    at_times,
    logged,
    record_from,
    scenario_of,
    with_rows,
)
from tests.identify.synthetic import quick, rss6, run_plant


@pytest.fixture(scope="module")
def guess():
    return starting_guess(load_robot("rss6"), "guess", 0.5)


def test_drawn_truths_follow_the_prior_within_the_bounds(guess):
    bounds = parameter_bounds(guess, physical=True)
    rng = np.random.default_rng(0)
    truths = np.array([drawn_truth(guess, bounds, rng).values for _ in range(400)])
    assert not any(bounds.outside(one).any() for one in truths)
    for name in ("joint1.coulomb", "joint_pid.lp", "platform.mass"):
        place = guess.layout.names.index(name)
        mean, std = guess.values[place], guess.std[place]
        expected = truncnorm((bounds.lower[place] - mean) / std, np.inf, mean, std)
        assert kstest(truths[:, place], expected.cdf).pvalue > 1e-3, name
    moments = truths[:, [guess.layout.names.index(f"platform.I{axis}{axis}") for axis in "xyz"]]
    assert np.all(2 * moments.max(axis=1) <= moments.sum(axis=1)), "no rigid body has these moments"


def test_stated_probabilities_are_those_of_the_normal_distribution_cut_at_the_bounds(guess):
    bounds = parameter_bounds(guess, physical=False)
    size = len(guess.values)
    at_bound = np.zeros(size, dtype=bool)
    std = np.where(np.arange(size) % 2, 0.3, 1.0) * np.maximum(guess.values, 1e-3)
    covariance = np.diag(std**2)
    found = bounded_estimate(guess.values, at_bound, np.zeros(size), covariance, covariance, bounds)
    truth = guess.values + 0.7 * std
    least = np.maximum(bounds.lower, 0)
    free = guess.values > 0
    expected = truncnorm((least - guess.values) / std, np.inf, guess.values, std).cdf(truth)
    below = found.probabilities(np.eye(size), truth)
    assert below[free] == pytest.approx(expected[free], abs=1e-12)


def test_poses_are_compared_where_the_platform_has_left_its_start():
    poses = np.zeros((6, 6))
    poses[2:, 4] = 1e-12, 1e-6, 2e-6, 0.0
    assert moving_frames(poses).tolist() == [3, 4]
    assert moving_frames(np.ones((6, 6))).tolist() == [5]


def test_a_record_without_its_beginning_is_what_the_reader_of_such_a_log_makes():
    """The rows of the log from 1.5 s on, with a clock of their own, as a laboratory would bring
    them.
    """
    scenario = scenario_of()
    record, run = run_plant(scenario, 0, duration_s=3.0)
    store_anchor(record, ScaleAnchor("platform_mass", 23.5, 0.005))
    record["command_time"] = ("time", record["time"].values + LATENCY_S)
    later = with_rows(logged(record, run), slice(90, None))
    times = later.poses.time
    expected = record_from(at_times(later, times - times[0]), scenario)
    found = log_of_moving_robot(record, 1.5, rss6())
    assert found.sizes["time"] == expected.sizes["time"] > 80
    for name in ("time", "acting", "command", "measured_position", "measured_orientation"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-12)
    assert found.attrs["scale_anchor_value"] == 23.5
    with pytest.raises(StudyError, match=r"log_from_s is 4 s, but the record ends after 2\.983 s"):
        log_of_moving_robot(record, 4.0, rss6())


def lightly_damped_row():
    """Row whose joints oscillate at 13 rad/s with a damping ratio of 0.13, from 1.5 s on."""
    scenario = quick(
        **{
            "renderer": "statistical",
            "identification.scale_anchor": "joint_gain",
            "identification.physical_consistency": True,
            "identification.start_std": 0.3,
        }
    )
    return compute(scenario, np.random.SeedSequence([7, 8]), CalibrationOptions(log_from_s=1.5))


@pytest.mark.thorough
def test_a_lightly_damped_truth_is_found_in_a_record_that_begins_in_motion():
    """A search over the whole record alone ended at 44,000 times the noise."""
    assert lightly_damped_row()["noise_ratio"] < 1.1


@pytest.mark.thorough
def test_the_first_result_stays_if_a_growing_window_makes_the_model_unstable(monkeypatch):
    def unstable(problem, start):
        raise DynamicsError("unstable")

    monkeypatch.setattr(output_error_search, "over_growing_window", unstable)
    row = lightly_damped_row()
    assert row["noise_ratio"] > 1.2
    assert row["intervals"] == 0


def probabilities(**figures):
    return pd.DataFrame({PROBABILITY + name: values for name, values in figures.items()})


@pytest.mark.slow
def test_right_distributions_pass_and_wrong_ones_are_named():
    rng = np.random.default_rng(3)
    right = {f"right{k}": rng.random(300) for k in range(40)}
    narrow = np.clip(0.5 + 1.5 * (rng.random(300) - 0.5), 0, 1)
    high = rng.random(300) ** 1.5
    done = probabilities(**right, narrow=narrow, high=high)
    found = judge_uniformity(done, [])
    assert {one.name for one in found if one.fails} == {"narrow", "high"}
    assert len(found) == 42
    labels = uniformity_figure(found).axes[0].get_legend().get_texts()
    assert {text.get_text() for text in labels[1:]} == {"narrow", "high"}
    assert judge_uniformity(done.head(10), []) == [], "too few rows for a test"


def test_points_of_a_study_are_judged_apart():
    rng = np.random.default_rng(4)
    opposite = np.concatenate([0.5 * rng.random(200), 0.5 + 0.5 * rng.random(200)])
    done = probabilities(mass=opposite).assign(robot=["rss6"] * 200 + ["rrr3"] * 200)
    assert not judge_uniformity(done, [])[0].fails
    apart = judge_uniformity(done, ["robot"])
    assert {one.label for one in apart} == {"rss6 mass", "rrr3 mass"}
    assert all(one.fails for one in apart)


@pytest.mark.parametrize("rows", [25, 300])
def test_the_band_contains_the_whole_curve_of_uniform_numbers_as_often_as_it_says(rows):
    points, low, high = simultaneous_band(rows)
    drawn = np.sort(np.random.default_rng(11).random((2000, rows)))
    curves = np.array([np.searchsorted(one, points, side="right") for one in drawn]) / rows - points
    inside = np.mean(np.all((low <= curves) & (curves <= high), axis=1))
    # Counts are whole numbers, so the band of few rows holds a little more.
    assert BAND - 0.015 < inside < BAND + 0.03
