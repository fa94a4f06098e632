"""How far the true plant may be from what the identified model predicts, on a motion that it was not identified from.

Two things keep the plant away from the model. The parameters are uncertain: their covariance C comes through the exact
sensitivities S of the model's poses as S C S^T. And the sensor's noise goes through the servo into the plant's motion,
which no model can foretell: its covariance is sampled by repeated experiments on the identified model, and is taken to
be the same all along the motion. What the sensor has wrong in every frame alike, such as the frames it was taught,
moves the whole motion with it and is not predicted: no record of this sensor shows it.
"""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.estimation.estimate_covariance import repeated_experiment
from identify.record.recorded_run import RecordedRun

REPETITIONS = 4
"""Repeated experiments a motion: with hundreds of frames each they know the noise's share of a deviation to 5 %."""


@dataclass(frozen=True)
class PosePrediction:
    """The model's poses (N, 6) [m, rad], and the covariance (N, 6, 6) of the plant's true ones about them."""

    poses: Array
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations (N, 6) [m, rad]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)), dtype=float)

    def normalised_squared_error(self, true: Array) -> float:
        """Mean over the frames of e^T P^-1 e / 6 with the error e of the true poses (N, 6): near one where P is right.

        Errors of parameters last for the whole motion: of a single run the figure spreads widely about one.
        """
        errors = true - self.poses
        weighted = np.linalg.solve(self.covariance, errors[..., None])[..., 0]
        return float(np.mean(np.sum(errors * weighted, axis=1))) / 6


def predict_poses(run: RecordedRun, parameters: Array, covariance: Array, rng: np.random.Generator) -> PosePrediction:
    """Predict a run with estimated parameters (67,) of covariance (67, 67).

    Of the run only the reference, the sensor's covariance and the lost frames count, not what was measured.
    Raises LoopFailure where the model, or its repetition with the sensor's noise, is unstable.
    """
    model = run.simulate(parameters, sensitivities=True)
    assert model.pose_sensitivity is not None
    drawn = [repeated_experiment(run, parameters, rng).pose - model.pose for _ in range(REPETITIONS)]
    noise = np.concatenate(drawn)
    from_parameters = model.pose_sensitivity @ covariance @ model.pose_sensitivity.transpose(0, 2, 1)
    return PosePrediction(model.pose, from_parameters + noise.T @ noise / len(noise))
