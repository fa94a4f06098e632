"""Prediction of the plant's poses from an identified model, with their covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy.linalg import block_diag
from scipy.ndimage import uniform_filter1d

from dynamics.closed_loop import LoopFailure
from dynamics.kinematics.platform import Chart
from identify.arrays import Array, normalised_square
from identify.estimation.base_parameters import structure
from identify.estimation.covariance import repeated_experiments
from identify.model.body_errors import body_errors
from identify.model.from_record import predicting_model
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.progress import Progress
from identify.random_streams import PREDICTION, stream_seed
from identify.record.checks import TooFewFramesError

# Name of a source of uncertainty: the sensor's noise, which moves the plant through the servo.
MOTION = "motion"
# Number of repeated experiments per motion. Averaged over NEIGHBOURS, they determine a frame's
# standard deviation due to noise to about 6 %.
REPETITIONS = 48
NEIGHBOURS = 5  # number of frames over which the covariance due to noise is averaged
# Weight of the mean over the motion in a frame's covariance due to noise. Without it, the
# covariance would be zero while the platform still rests at the start.
SHRINKAGE = 0.02


@dataclass(frozen=True)
class PosePrediction:
    """Predicted poses of the plant with their covariance.

    The poses of plant and model differ for three reasons:

    - The parameters are uncertain. Their covariance C acts through the exact sensitivities S of
      the model's poses as S C S^T.
    - The sensor's noise moves the plant through the servo, which no model can predict. The
      covariance of this motion is sampled by repeated experiments on the identified model. It
      differs from frame to frame, because sticking joints follow the noise less than slipping ones.
    - All measured poses have common errors that the record states, and the geometry has errors. The
      servo compensates such an error in the measured pose, and thereby shifts the platform. The
      error is constant along the motion. Poses and covariance contain its estimate from the record
      of the identification.

    chart                 Coordinates of the platform.
    poses (N, 6)          Predicted poses, m and rad.
    covariance (N, 6, 6)  Covariance of the plant's true poses about the predicted poses. It is zero
                          along directions in which the platform cannot move.
    slopes (N, 6, p)      Sensitivities of the poses to the parameters. They are None unless no
                          frame is lost, poses have no common errors, the platform carries no load,
                          and the servo drives the model.
    """

    chart: Chart
    poses: Array
    covariance: Array
    slopes: Array | None = None

    @property
    def std(self) -> Array:
        """Standard deviations (N, 6) [m, rad]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)), dtype=float)

    def normalised_squared_error(self, true: Array) -> float:
        """Return the mean of e^T P^-1 e / m over the frames.

        The error e of the true poses (N, 6) is expressed in the m coordinates of the platform. The
        result is near one if the covariance P is right. Errors of parameters last for the whole
        motion, so the result of a single run scatters widely about one.

        While joints stick, the platform moves along fewer than m directions. P is then singular,
        and only the directions with a variance count. The result is NaN if P is.
        """
        free = self.chart.basis
        return normalised_square((true - self.poses) @ free, free.T @ self.covariance @ free)


def predict_poses(
    run: LoopModel,
    parameters: Array,
    covariance: Array,
    rng: np.random.Generator,
    learned: Mapping[str, float] | None = None,
) -> PosePrediction:
    """Return the predicted poses of a run with estimated parameters.

    The prediction uses the reference, the sensor's covariance and the lost frames of the run, but
    not its measured poses.

    run                             Model of the run.
    parameters (p,)                 Estimates.
    covariance (p, p) or (p + k, p + k)
                                    Covariance of the estimates, or of the estimates and the learned
                                    errors.
    rng                             Source of the noise of the repeated experiments.
    learned                         Estimates, by name, of k common errors of this run and of the
                                    record of the identification. If the names differ from the
                                    errors of the run, the prior of the run's errors is used.

    Raises LoopFailure if the model, or its repetition with the sensor's noise, is unstable.
    """
    basis = _basis(run, parameters, covariance, rng, learned or {})
    alone = run.ok.all() and not (run.driven or run.common.all_names or run.payload.any())
    by_parameters = basis.slopes[..., : len(parameters)]
    return PosePrediction(
        run.robot.geometry.chart,
        basis.poses,
        basis.spread(basis.known) + basis.by_noise,
        by_parameters if alone else None,
    )


@dataclass(frozen=True)
class _Basis:
    """Predicted poses (N, 6), and the matrices that determine their covariance.

    slopes (N, 6, p + k): derivatives of the poses with respect to the parameters and to the numbers
    of `_known_in_common`. known (p + k, p + k): covariance of these parameters and numbers.
    by_noise (N, 6, 6): covariance of the motion due to the sensor's noise.
    """

    poses: Array
    slopes: Array
    known: Array
    by_noise: Array

    def spread(self, covariance: Array) -> Array:
        """Return the poses' covariance (N, 6, 6) for another covariance in place of `known`."""
        return np.asarray(self.slopes @ covariance @ self.slopes.transpose(0, 2, 1))


def _basis(
    run: LoopModel,
    parameters: Array,
    covariance: Array,
    rng: np.random.Generator,
    learned: Mapping[str, float],
) -> _Basis:
    """Return the linear prediction of a run. For arguments and errors see `predict_poses`."""
    likely, root, known = _known_in_common(run, covariance, len(parameters), learned)
    inside = len(run.errors_had)
    run = replace(run, bodies=body_errors(run, parameters)).having(likely[:inside])
    model = run.simulate(parameters, sensitivities=True)
    assert model.pose_sensitivity is not None
    drawn = []
    for repeated in repeated_experiments(run, parameters, [rng] * REPETITIONS):
        if isinstance(repeated, LoopFailure):
            raise repeated
        drawn.append(repeated.pose - model.pose)
    common = run.pose_modes(parameters)
    by_parameters = run.of_all(model.pose_sensitivity)
    slopes = np.concatenate([by_parameters, common @ root], axis=2)
    poses = model.pose + common[:, :, inside:] @ likely[inside:]
    return _Basis(poses, slopes, known, covariance_by_noise(np.array(drawn)))


def covariance_by_noise(deviations: Array) -> Array:
    """Return the covariance (N, 6, 6) of the poses of a motion from repeated deviations (r, N, 6).

    Deviations due to noise have mean zero, so their second moment is the covariance. It is averaged
    over neighbouring frames, and shrunk towards its mean over the motion.
    """
    each = np.einsum("rni,rnj->nij", deviations, deviations) / len(deviations)
    local = uniform_filter1d(each, NEIGHBOURS, axis=0, mode="nearest")
    return np.asarray((1.0 - SHRINKAGE) * local + SHRINKAGE * each.mean(axis=0))


def _known_in_common(
    run: LoopModel, covariance: Array, parameters: int, learned: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """Return what is known beforehand about the common errors of a run's poses.

    The errors are a linear function of k independent numbers. The covariance of learned errors is
    known, and otherwise that of the numbers. The first result is the most likely values (k,) of the
    numbers. The second is the matrix (k, k) from the quantities of known covariance to the numbers.
    The third is the covariance (p + k, p + k) of the parameters and these quantities.
    """
    names = run.common.all_names
    if names and tuple(learned) == names:
        # The factor has no inverse if the covariance lacks full rank.
        root = np.asarray(np.linalg.pinv(run.common.whole_factor))
        return root @ np.array([*learned.values()]), root, covariance
    identity = np.eye(len(names))
    whole = np.asarray(block_diag(covariance[:parameters, :parameters], identity))
    return np.zeros(len(names)), identity, whole


def predicted_runs(
    side: ModelSide,
    records: Sequence[xr.Dataset],
    parameters: Array,
    covariance: Array,
    seed: int,
    progress: Progress,
    learned: Mapping[str, float] | None = None,
) -> list[PosePrediction]:
    """Predict the plant on the references of records from the identified model.

    For ``parameters``, ``covariance`` and ``learned`` see `predict_poses`. A prediction is NaN if
    the loop is unstable, or if too few frames were measured to determine the sensor's noise.

    Raises RecordError or EstimationError for a record that is damaged, or of another robot, timing
    or servo. Raises dynamics.DynamicsError for parameters that no model can have.
    """
    predictions = []
    with progress.stage("predict", len(records)) as advance:
        for number, record in enumerate(records, start=1):
            try:
                run, rng = _predicting(side, record, seed, number)
                prediction = predict_poses(run, parameters, covariance, rng, learned)
            except (LoopFailure, TooFewFramesError):
                shape = (record.sizes["time"], 6)
                chart = side.robot.geometry.chart
                prediction = PosePrediction(
                    chart, np.full(shape, np.nan), np.full((*shape, 6), np.nan)
                )
            predictions.append(prediction)
            advance()
    return predictions


def _predicting(
    side: ModelSide, record: xr.Dataset, seed: int, number: int
) -> tuple[LoopModel, np.random.Generator]:
    """Return the model of a record to predict, and the generator of its noise."""
    run = replace(predicting_model(record, side), groups=structure(side.robot).rigid_groups)
    return run, np.random.default_rng(stream_seed(seed, PREDICTION, number))


def predicted_variances(
    side: ModelSide,
    record: xr.Dataset,
    number: int,
    parameters: Array,
    sources: Mapping[str, Array],
    seed: int,
    learned: Mapping[str, float] | None = None,
) -> dict[str, Array]:
    """Return the parts (N, 6) of the variance of a prediction by the sources of its uncertainty.

    `sources` (p + k, p + k) are the parts of the covariance by their names. The motion due to the
    sensor's noise is another source, MOTION. Common errors that the record of the identification
    does not determine are further sources. `number` (that of the record, from one on) and `seed`
    select the noise, as in `predicted_runs`. Raises LoopFailure if the loop is unstable, and
    TooFewFramesError if too few frames were measured.
    """
    run, rng = _predicting(side, record, seed, number)
    whole = np.asarray(sum(sources.values()))
    basis = _basis(run, parameters, whole, rng, learned or {})
    count = len(parameters)
    size = len(basis.known)
    parts = dict(sources)
    if basis.known is not whole:
        of_errors = np.eye(size - count)
        parts = {
            name: block_diag(part[:count, :count], 0 * of_errors) for name, part in parts.items()
        }
        for kind, modes in run.common.by_kind(of_errors).items() if size > count else ():
            so_far = parts.get(kind, np.zeros((size, size)))
            parts[kind] = so_far + block_diag(np.zeros((count, count)), modes @ modes.T)
    variances = {
        name: np.diagonal(basis.spread(part), axis1=1, axis2=2) for name, part in parts.items()
    }
    return variances | {MOTION: np.diagonal(basis.by_noise, axis1=1, axis2=2)}
