"""Predicted deviations of the plant from the identified model, against the deviations found."""

import numpy as np
import pytest

from identify.estimation.identification import identify
from identify.estimation.pose_prediction import PosePrediction, predict_poses
from identify.progress import SilentProgress
from identify.record.recorded_run import recorded_run
from identify.reporting.run_result import prediction_entry
from identify.validation import predicted_runs
from tests.identify.estimator_evidence import truth_of
from tests.identify.synthetic import quick, rss6, run_plant, truth


def test_normalised_squared_error_is_one_for_errors_of_the_stated_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(4000, 6)) @ root.T
    prediction = PosePrediction(np.zeros((4000, 6)), np.broadcast_to(root @ root.T, (4000, 6, 6)))
    assert prediction.normalised_squared_error(errors) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 24000))
    assert prediction.normalised_squared_error(2 * errors) == pytest.approx(4.0, rel=0.05)
    np.testing.assert_allclose(prediction.std[7], np.sqrt(np.diag(root @ root.T)))


def test_where_nothing_can_be_predicted_nothing_is_said():
    """Too many frames lost to know the sensor's noise; and a model whose loop is unstable."""
    scenario, known = quick(), np.zeros((67, 67))
    dark, plant = run_plant(scenario, 0, duration_s=2.0, lost=range(80))
    good, _ = run_plant(scenario, 0, duration_s=2.0)
    unstable = truth() * np.where(np.arange(67) >= 64, -1.0, 1.0)
    for record, parameters in ((dark, truth()), (good, unstable)):
        (prediction,) = predicted_runs(rss6(), scenario, [record], parameters, known, 0, SilentProgress())
        assert prediction.std.shape == (120, 6)
        assert np.isnan(prediction.std).all()
        figures = prediction_entry(prediction, truth_of(plant))["predicted"]
        assert np.isnan(figures["normalised_squared_error"])


@pytest.mark.slow
def test_exactly_known_parameters_leave_what_the_noise_does_through_the_servo():
    """With the true parameters and no covariance the plant strays by the noise's share alone: twelve motions."""
    scenario, ratios = quick(**{"plant.steps_per_frame": 4}), []
    for seed in range(12):
        record, plant = run_plant(scenario, seed=100 + seed, trajectory_seed=50 + seed, duration_s=5.0)
        run = recorded_run(record, rss6(), scenario)
        prediction = predict_poses(run, truth(), np.zeros((67, 67)), np.random.default_rng(seed))
        ratios.append(prediction.normalised_squared_error(plant.pose))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1), ratios


@pytest.mark.slow
def test_the_error_on_unseen_motions_is_the_one_predicted():
    """Squared error of the identified model against the true plant in units of what was predicted: one on average.

    Six identifications, two unseen motions each. The starting guess, which is closer than it says, makes it a little
    smaller.
    """
    scenario, ratios = quick(), []
    for seed in range(6):
        result = identify(run_plant(scenario, seed=seed)[0], rss6(), scenario)
        for unseen in (2 * seed, 2 * seed + 1):
            record, plant = run_plant(scenario, seed=100 + unseen, trajectory_seed=50 + unseen, duration_s=5.0)
            rng = np.random.default_rng(unseen)
            prediction = predict_poses(
                recorded_run(record, rss6(), scenario), result.estimate, result.covariance, rng
            )
            ratios.append(prediction.normalised_squared_error(plant.pose))
    assert 0.8 < np.mean(ratios) < 1.2, ratios
