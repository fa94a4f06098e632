"""Predicted deviations of the plant from the identified model, against the deviations found."""

import numpy as np
import pytest

from dynamics.closed_loop import LoopFailure
from dynamics.errors import ParameterError
from identify.errors import EstimationError
from identify.progress import SilentProgress
from identify.record.recorded_run import recorded_run
from identify.reporting.run_result import prediction_entry
from identify.validation.unseen import PosePrediction, predicted_runs
from tests.identify.synthetic import SIGMA, quick, rss6, run_plant, truth, truth_of


def test_normalised_squared_error_is_one_for_errors_of_the_stated_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(4000, 6)) @ root.T
    prediction = PosePrediction(np.zeros((4000, 6)), np.broadcast_to(root @ root.T, (4000, 6, 6)))
    assert prediction.normalised_squared_error(errors) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 24000))
    assert prediction.normalised_squared_error(2 * errors) == pytest.approx(4.0, rel=0.05)
    np.testing.assert_allclose(prediction.std[7], np.sqrt(np.diag(root @ root.T)))


def test_where_nothing_can_be_predicted_nothing_is_said():
    """Too many frames lost to know the sensor's noise; and a model whose loop is unstable: the starting guess, which
    has no friction, at 29 Hz with a frame of latency."""
    slow = quick(sensor="ctrack780_29hz")
    unstable, known = rss6().parameter_sets["initial"].vector, np.zeros((67, 67))
    dark, plant = run_plant(quick(), 0, duration_s=2.0, lost=range(80))
    good, plant_29hz = run_plant(slow, 0, duration_s=8.0)
    with pytest.raises(LoopFailure, match="the loop is unstable"):
        recorded_run(good, rss6(), slow).model_poses(unstable)
    for scenario, record, parameters, true in ((quick(), dark, truth(), plant), (slow, good, unstable, plant_29hz)):
        (prediction,) = predicted_runs(rss6(), scenario, [record], parameters, known, 0, SilentProgress())
        assert prediction.std.shape == (record.sizes["time"], 6)
        assert np.isnan(prediction.std).all()
        figures = prediction_entry(prediction, truth_of(true))["predicted"]
        assert np.isnan(figures["normalised_squared_error"])


def test_a_motion_too_short_to_identify_from_can_be_predicted_and_what_cannot_be_asked_is_an_error():
    """With exactly known parameters what remains is what the servo lets through of the sensor's noise. Another robot,
    another servo and parameters of no model are errors, as everywhere else."""
    record, plant = run_plant(quick(), 0, duration_s=0.5)

    def predicted(record, parameters, **scenario):
        return predicted_runs(rss6(), quick(**scenario), [record], parameters, np.zeros((67, 67)), 0, SilentProgress())

    (prediction,) = predicted(record, truth())
    np.testing.assert_allclose(prediction.poses[0], plant.pose[0])
    assert np.all((prediction.std > 0) & (prediction.std < SIGMA))
    with pytest.raises(EstimationError, match="is of robot 'rss7', not of 'rss6'"):
        predicted(record.assign_attrs(robot="rss7"), truth())
    with pytest.raises(EstimationError, match=r"made with servo.kp = 0.3, the scenario says 0.2"):
        predicted(record, truth(), **{"servo.kp": 0.2})
    with pytest.raises(ParameterError, match=r"platform.mass = -23.5 kg is not allowed"):
        predicted(record, -truth())
