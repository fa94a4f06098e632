"""Validation: plant and models on trajectories that were not used for the estimate (section 4.3).

The expected difference between plant and model is also predicted.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.sharedctypes import Synchronized

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

import cmmsim
from dynamics import Robot
from dynamics.closed_loop import (
    IdealSensor,
    LoopFailure,
    LoopSettings,
    Reference,
    simulate_servo,
)
from dynamics.closed_loop.start_state import (
    checked_loop_parameters,
)
from dynamics.kinematics.platform import Chart
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.estimation.covariance import repeated_experiments
from identify.excitation.design import Design, unseen_trajectories
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment, run_plant
from identify.experiment.sensor_in_loop import SensorPlan
from identify.model.body_errors import body_errors
from identify.model.from_record import predicting_model
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.progress import Advance, Progress
from identify.random_streams import PREDICTION, stream_seed
from identify.record.checks import TooFewFramesError
from identify.record.conditions import SERVO, logged_latencies, recorded_law
from identify.record.recording import is_timed, recorded_reference
from identify.runtime import cores
from identify.trajectory import FourierTrajectory
from identify.validation.worker_processes import mapped

POLL_S = 0.2
"""Interval at which the progress of the workers is read, s."""


def run_unseen(
    plant: Plant,
    sensor: SensorPlan,
    taught: cmmsim.Taught,
    trajectories: tuple[FourierTrajectory, ...],
    duration_s: float,
    seed: int,
    workers: int | None,
    progress: Progress,
) -> list[Experiment]:
    """Run a plant with images in the loop on every trajectory, each for a duration.

    The work is distributed to `workers` processes. None means one process per core. Every run has
    its own noise stream, and all runs share the taught frames, so the results do not depend on the
    number of workers.
    """
    how = (plant, sensor, taught, duration_s, seed)
    workers = workers or cores()
    numbers = range(1, len(trajectories) + 1)
    frames = plant.runs.timing.frames(duration_s) * len(trajectories)
    with progress.stage("validate", frames) as advance:
        # For a single process no pool is needed.
        if workers == 1 or len(trajectories) == 1:
            worker = _Worker(*how)
            return [
                worker.run(number, path, advance)
                for number, path in zip(numbers, trajectories, strict=True)
            ]
        context = multiprocessing.get_context("spawn")
        # Workers count frames here, because a callback cannot reach another process.
        counter: Synchronized[int] = context.Value("q", 0)
        start = partial(_start_worker, counter, *how)
        with (
            _followed(counter, advance),
            mapped(workers, _run_in_worker, numbers, trajectories, start=start) as runs,
        ):
            return list(runs)


def model_run(
    robot: Robot,
    settings: LoopSettings,
    parameters: Array,
    reference: Reference,
    latencies: Array | None = None,
    lost: NDArray[np.bool_] | None = None,
) -> Array:
    """Return the poses (N, 6) of the model on a reference. All are NaN if its loop is unstable.

    ``latencies`` (N,) [s] are the latencies of its commands, by default the latency of the timing.
    In ``lost`` (N,) frames its servo measures nothing, by default in none.

    Raises dynamics.DynamicsError for parameters of another shape or outside their range, and for
    poses out of reach.
    """
    try:
        sensor = IdealSensor(lost=lost)
        return simulate_servo(
            robot, parameters, reference, settings, sensor, latencies=latencies
        ).pose
    except LoopFailure:
        return np.full_like(reference.poses, np.nan)


def model_on_record(side: ModelSide, parameters: Array, record: xr.Dataset) -> Array:
    """Return the poses (N, 6) of the model on the motion of a record.

    All poses are NaN if the model is unstable. Latencies and lost frames are those of the record,
    because the servo of the model must hold its commands where the plant's did. If the record was
    made under the servo, the model simulates the servo. Otherwise the logged commands drive the
    model.

    Raises the errors of `model_run`.
    """
    if recorded_law(record) == SERVO and not is_timed(record):
        latencies = logged_latencies(record, side.timing)
        reference = recorded_reference(record)
        lost = record["measured_ok"].values == 0
        return model_run(side.robot, side.settings, parameters, reference, latencies, lost)
    run = predicting_model(record, side).driven_by_commands()
    try:
        return run.model_poses(parameters)
    except LoopFailure:
        return np.full_like(run.measured, np.nan)


REPETITIONS = 4
"""Number of repeated experiments per motion.

With hundreds of frames each, they determine the effect of noise to 5 %.
"""


@dataclass(frozen=True)
class PosePrediction:
    """Predicted poses of the plant with their covariance.

    The poses of plant and model differ for three reasons:

    - The parameters are uncertain. Their covariance C acts through the exact sensitivities S of
      the model's poses as S C S^T.
    - The sensor's noise moves the plant through the servo, which no model can predict. The
      covariance of this motion is sampled by repeated experiments on the identified model, and is
      assumed constant along the motion.
    - All measured poses have common errors that the record states, and the geometry has errors. The
      servo compensates such an error in the measured pose, and thereby shifts the platform. The
      error is constant along the motion. Poses and covariance contain its estimate from the record
      of the identification.

    Attributes
    ----------
    chart : Chart
        Coordinates of the platform.
    poses : ndarray, shape (N, 6)
        Predicted poses, m and rad.
    covariance : ndarray, shape (N, 6, 6)
        Covariance of the plant's true poses about the predicted poses. It is zero along directions
        in which the platform cannot move.
    slopes : ndarray, shape (N, 6, p), optional
        Sensitivities of the poses. They are given only if no frame is lost, poses have no common
        errors, the platform carries no load, and the servo drives the model.
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
        """Return the mean over the frames of e^T P^-1 e / m.

        The error e of the true poses (N, 6) is expressed in the m coordinates of the platform. The
        result is near one if the covariance P is right. Errors of parameters last for the whole
        motion, so the result of a single run scatters widely about one.
        """
        free = self.chart.basis
        errors = (true - self.poses) @ free
        weighted = np.linalg.solve(free.T @ self.covariance @ free, errors[..., None])[..., 0]
        return float(np.mean(np.sum(errors * weighted, axis=1))) / free.shape[1]


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

    Parameters
    ----------
    run : LoopModel
        Model of the run.
    parameters : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p) or (p + k, p + k)
        Covariance of the estimates, or of the estimates and the learned errors.
    rng : numpy.random.Generator
        Source of the noise of the repeated experiments.
    learned : mapping, optional
        Estimates, by name, of k common errors of this run and of the record of the identification.
        If the names differ from the errors of the run, the prior of the run's errors is used.

    Raises
    ------
    LoopFailure
        If the model, or its repetition with the sensor's noise, is unstable.
    """
    likely, root, known = _known_in_common(run, covariance, len(parameters), learned or {})
    inside = len(run.errors_had)
    run = replace(run, bodies=body_errors(run, parameters)).having(likely[:inside])
    model = run.simulate(parameters, sensitivities=True)
    assert model.pose_sensitivity is not None
    drawn = []
    for repeated in repeated_experiments(run, parameters, [rng] * REPETITIONS):
        if isinstance(repeated, LoopFailure):
            raise repeated
        drawn.append(repeated.pose - model.pose)
    noise = np.concatenate(drawn)
    common = run.pose_modes(parameters)
    by_parameters = run.of_all(model.pose_sensitivity)
    slopes = np.concatenate([by_parameters, common @ root], axis=2)
    # Deviations by noise have mean zero, so their second moment is the covariance.
    spread = slopes @ known @ slopes.transpose(0, 2, 1) + noise.T @ noise / len(noise)
    alone = run.ok.all() and not (run.driven or run.common.all_names or run.payload.any())
    poses = model.pose + common[:, :, inside:] @ likely[inside:]
    return PosePrediction(run.robot.geometry.chart, poses, spread, by_parameters if alone else None)


def _known_in_common(
    run: LoopModel, covariance: Array, parameters: int, learned: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """Return what is known beforehand about the common errors of a run's poses.

    The errors are a linear function of k independent numbers. The first result (k,) is the most
    likely values of these numbers. The second is the matrix (k, k) from the numbers with known
    covariance to these numbers. The third is the covariance (p + k, p + k) of the parameters and
    the numbers with known covariance.
    """
    names = run.common.all_names
    if names and tuple(learned) == names:
        # The factor has no inverse if the covariance lacks full rank.
        root = np.asarray(np.linalg.pinv(run.common.whole_factor))
        return root @ np.array([*learned.values()]), root, covariance
    each = np.eye(len(names))
    whole = np.asarray(block_diag(covariance[:parameters, :parameters], each))
    return np.zeros(len(names)), each, whole


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

    The parameters (p,) have covariance (p, p). For ``learned`` see `predict_poses`. All poses of a
    prediction are NaN if the loop is unstable, or if too few frames were measured to determine the
    sensor's noise.

    Raises RecordError or EstimationError for a record that is damaged, or of another robot, timing
    or servo. Raises dynamics.DynamicsError for parameters that no model can have.
    """
    groups = structure(side.robot).rigid_groups
    predictions = []
    with progress.stage("predict", len(records)) as advance:
        for number, record in enumerate(records, start=1):
            rng = np.random.default_rng(stream_seed(seed, PREDICTION, number))
            try:
                run = replace(predicting_model(record, side), groups=groups)
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


class _Worker:
    """Plant and sensor of one process. The renderer is reused for all runs."""

    def __init__(
        self, plant: Plant, sensor: SensorPlan, taught: cmmsim.Taught, duration_s: float, seed: int
    ) -> None:
        self._plant = plant
        self._seed = seed
        self._duration_s = duration_s
        self._sensor = sensor.make(plant.nominal, seed, taught)

    def run(self, number: int, trajectory: FourierTrajectory, advance: Advance) -> Experiment:
        return run_plant(
            self._plant, self._sensor, trajectory, self._duration_s, self._seed, number, advance
        )


_worker: _Worker
_counter: Synchronized[int]


def _start_worker(
    counter: Synchronized[int],
    plant: Plant,
    sensor: SensorPlan,
    taught: cmmsim.Taught,
    duration_s: float,
    seed: int,
) -> None:
    # A process of a pool can store its state only in module variables.
    global _worker, _counter
    _worker = _Worker(plant, sensor, taught, duration_s, seed)
    _counter = counter


def _run_in_worker(number: int, trajectory: FourierTrajectory) -> Experiment:
    def advance(n: int = 1) -> None:
        with _counter.get_lock():
            _counter.value += n

    return _worker.run(number, trajectory, advance)


@contextmanager
def _followed(counter: Synchronized[int], advance: Advance) -> Iterator[None]:
    """Update the progress bar with the count of the workers until the context ends."""
    done = 0
    ended = threading.Event()

    def follow() -> None:
        nonlocal done
        while not ended.wait(POLL_S):
            now = counter.value
            advance(now - done)
            done = now

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        advance(counter.value - done)


def errors_of_model(parameters: ArrayLike, plant: Plant, design: Design, seed: int) -> Array:
    """Return the pose errors (runs, N, 6) [m, rad] of a model against the plant.

    Both run on the validation trajectories of a seed, each with its own friction law and steps. An
    ideal sensor closes both loops, so the errors are caused only by the parameters (p,) and by
    effects that the model lacks. They are NaN if, and only if, the model's loop is unstable.

    Raises dynamics.DynamicsError for parameters of another shape, not finite, or outside their
    range. Raises TrajectoryError if no validation trajectory is within the robot's limits.
    """
    robot = plant.nominal
    settings = plant.loop.side.settings
    values = checked_loop_parameters(robot, parameters, settings.drives.law)
    times = plant.runs.timing.frame_times(design.unseen.duration_s)
    references = [path.reference(times) for path in unseen_trajectories(design, seed)]
    model = [model_run(robot, settings, values, reference) for reference in references]
    return np.array(model) - np.array([plant.run(reference).pose for reference in references])
