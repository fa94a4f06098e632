"""Validation: plant and models on trajectories that the estimator never saw, and how far apart they
should be (4.3).
"""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.sharedctypes import Synchronized

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

import cmmsim
from dynamics import Robot
from dynamics.closed_loop import LoopFailure, Reference, simulate_servo
from dynamics.closed_loop.start_state import (
    checked_loop_parameters,
)
from dynamics.kinematics.chart import Chart
from identify.arrays import Array
from identify.estimation.base_parameters import structure
from identify.estimation.covariance import repeated_experiments
from identify.excitation.design import unseen_trajectories
from identify.experiment.plant import build_plant
from identify.experiment.run import Experiment, run_plant
from identify.experiment.sensor_in_loop import make_sensor
from identify.loop_parameters import model_settings
from identify.model.from_record import predicting_model
from identify.model.loop_model import LoopModel
from identify.progress import Advance, Progress
from identify.random_streams import PREDICTION, stream_seed
from identify.record.checks import TooFewFramesError
from identify.record.command_times import logged_latencies
from identify.record.known_geometry import KnownGeometry
from identify.record.law import SERVO, recorded_law
from identify.record.recording import recorded_reference
from identify.runtime import cores
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory

POLL_S = 0.2


def run_unseen(
    scenario: Scenario,
    trajectories: tuple[FourierTrajectory, ...],
    seed: int,
    taught: cmmsim.Taught,
    workers: int | None,
    progress: Progress,
    known: KnownGeometry | None = None,
) -> list[Experiment]:
    """Run the plant with images in the loop on every trajectory, in `workers` processes, None: one
    a core.

    Every run has its own noise stream, and all share what the sensor was taught: results do not
    depend on the workers. known: what is known of the geometry, where that is at hand.
    """
    how = (scenario, seed, taught, known)
    workers = workers or cores()
    numbers = range(1, len(trajectories) + 1)
    frames = scenario.timing.frames(scenario.validation.duration_s) * len(trajectories)
    with progress.stage("validate", frames) as advance:
        if workers == 1 or len(trajectories) == 1:
            worker = _Worker(*how)
            return [
                worker.run(number, path, advance)
                for number, path in zip(numbers, trajectories, strict=True)
            ]
        context = multiprocessing.get_context("spawn")
        counter: Synchronized[int] = context.Value("q", 0)
        with (
            _followed(counter, advance),
            ProcessPoolExecutor(workers, context, _start_worker, (counter, *how)) as pool,
        ):
            return list(pool.map(_run_in_worker, numbers, trajectories))


def model_run(
    robot: Robot,
    scenario: Scenario,
    parameters: Array,
    reference: Reference,
    latencies: Array | None = None,
) -> Array:
    """Poses (N, 6) of the model on a reference; NaN throughout when its loop is unstable.

    latencies (N,): of its commands, s; None: that of the timing. Raises dynamics.DynamicsError for
    what is no model: parameters of another shape or outside their range, poses out of reach.
    """
    try:
        return simulate_servo(
            robot, parameters, reference, model_settings(robot, scenario), latencies=latencies
        ).pose
    except LoopFailure:
        return np.full_like(reference.poses, np.nan)


def model_on_record(
    robot: Robot, scenario: Scenario, parameters: Array, record: xr.Dataset
) -> Array:
    """Poses (N, 6) of the model on the motion of a record, with the latencies that it logs: in the
    servo's loop where that made the record, and under the logged commands where another law did;
    NaN throughout where it is unstable. Raises as `model_run`."""
    if recorded_law(record) == SERVO:
        latencies = logged_latencies(record, scenario.timing)
        return model_run(robot, scenario, parameters, recorded_reference(record), latencies)
    run = predicting_model(record, robot, scenario).driven_by_commands()
    try:
        return run.model_poses(parameters)
    except LoopFailure:
        return np.full_like(run.measured, np.nan)


REPETITIONS = 4
"""Repeated experiments a motion: with hundreds of frames each they know the noise's share of a
deviation to 5 %.
"""


@dataclass(frozen=True)
class PosePrediction:
    """The model's poses (N, 6) [m, rad], and the covariance (N, 6, 6) of the plant's true ones
    about them, of a robot with this chart; zero where that forbids motion.

    Three things keep the plant away from the model. The parameters are uncertain: their covariance
    C comes through the exact sensitivities S of the model's poses as S C S^T. The sensor's noise
    goes through the servo into the plant's motion, which no model can foretell: its covariance is
    sampled by repeated experiments on the identified model, and is taken to be the same all along
    the motion. And what all measured poses have in common, as far as the record states it, and the
    geometry: the servo takes the platform where such an error does not show, the whole motion with
    the same draw. What the record of the identification taught of that draw is in poses and
    covariance.

    slopes (N, 6, p): sensitivities of the poses, where these are of reference and latencies alone:
    no frame is lost, and poses have nothing in common.
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
        """Mean over the frames of e^T P^-1 e / m with the error e of the true poses (N, 6) in the m
        coordinates of the platform: near one where P is right.

        Errors of parameters last for the whole motion: of a single run the figure spreads widely
        about one.
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
    """Predict a run with estimated parameters (p,) of covariance (p, p).

    learned: estimates, by name, of k errors that the poses of this run have in common with those of
    the record; then the covariance (p + k, p + k) is theirs, too. Otherwise they are as well known
    as the run states.

    Of the run only the reference, the sensor's covariance and the lost frames count, not what was
    measured. Raises LoopFailure where the model, or its repetition with the sensor's noise, is
    unstable.
    """
    likely, root, known = _known_in_common(run, covariance, len(parameters), learned or {})
    inside = len(run.errors_had)
    run = run.having(likely[:inside])
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
    spread = slopes @ known @ slopes.transpose(0, 2, 1) + noise.T @ noise / len(noise)
    alone = run.ok.all() and not (run.driven or run.common.all_names or run.payload.any())
    poses = model.pose + common[:, :, inside:] @ likely[inside:]
    return PosePrediction(run.robot.geometry.chart, poses, spread, by_parameters if alone else None)


def _known_in_common(
    run: LoopModel, covariance: Array, parameters: int, learned: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """What is known of the errors that a run's poses have in common: the most likely of the
    independent numbers (k,) of which they are made, what turns k known numbers into these (k, k),
    and the covariance (p + k, p + k) of parameters and known numbers."""
    names = run.common.all_names
    if names and tuple(learned) == names:
        root = np.asarray(np.linalg.pinv(run.common.whole_factor))
        return root @ np.array([*learned.values()]), root, covariance
    each = np.eye(len(names))
    return (
        np.zeros(len(names)),
        each,
        np.asarray(block_diag(covariance[:parameters, :parameters], each)),
    )


def predicted_runs(
    robot: Robot,
    scenario: Scenario,
    records: Sequence[xr.Dataset],
    parameters: Array,
    covariance: Array,
    seed: int,
    progress: Progress,
    learned: Mapping[str, float] | None = None,
) -> list[PosePrediction]:
    """What the identified model (p,) with its covariance (p, p) predicts for the plant on the
    references of records; learned: as of `predict_poses`.

    NaN throughout where its loop is unstable, or too little was measured to know the sensor's
    noise.

    Raises RecordError, EstimationError: a record that is damaged, or of another robot, timing or
    servo. Raises dynamics.DynamicsError: parameters that no model can have.
    """
    predictions = []
    with progress.stage("predict", len(records)) as advance:
        for number, record in enumerate(records, start=1):
            rng = np.random.default_rng(stream_seed(seed, PREDICTION, number))
            try:
                run = replace(
                    predicting_model(record, robot, scenario), groups=structure(robot).rigid_groups
                )
                prediction = predict_poses(run, parameters, covariance, rng, learned)
            except (LoopFailure, TooFewFramesError):
                shape = (record.sizes["time"], 6)
                chart = robot.geometry.chart
                prediction = PosePrediction(
                    chart, np.full(shape, np.nan), np.full((*shape, 6), np.nan)
                )
            predictions.append(prediction)
            advance()
    return predictions


class _Worker:
    """One process's plant and sensor; the renderer lives as long as the process."""

    def __init__(
        self, scenario: Scenario, seed: int, taught: cmmsim.Taught, known: KnownGeometry | None
    ) -> None:
        self._plant = build_plant(scenario, seed=seed, known=known)
        self._seed = seed
        self._duration_s = scenario.validation.duration_s
        self._sensor = make_sensor(scenario, self._plant.nominal, seed, taught)

    def run(self, number: int, trajectory: FourierTrajectory, advance: Advance) -> Experiment:
        return run_plant(
            self._plant, self._sensor, trajectory, self._duration_s, self._seed, number, advance
        )


_worker: _Worker
_counter: Synchronized[int]


def _start_worker(
    counter: Synchronized[int],
    scenario: Scenario,
    seed: int,
    taught: cmmsim.Taught,
    known: KnownGeometry | None,
) -> None:
    global _worker, _counter
    _worker = _Worker(scenario, seed, taught, known)
    _counter = counter


def _run_in_worker(number: int, trajectory: FourierTrajectory) -> Experiment:
    def advance(n: int = 1) -> None:
        with _counter.get_lock():
            _counter.value += n

    return _worker.run(number, trajectory, advance)


@contextmanager
def _followed(counter: Synchronized[int], advance: Advance) -> Iterator[None]:
    """Pass what the workers have counted on to the progress bar until the context ends."""
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


def unseen_errors(parameters: ArrayLike, robot: Robot, scenario: Scenario, seed: int = 0) -> Array:
    """Pose errors (runs, N, 6) [m, rad] of the model with these parameters (p,) against the plant
    with the true ones.

    On the scenario's unseen trajectories for this seed; plant and model each with their own
    friction law and steps. Both see by an ideal sensor, so that only the parameters and what the
    model leaves out make the error. NaN where the model's loop is unstable, and only there.

    Raises dynamics.DynamicsError: parameters of another shape, not finite, or outside their range.
    Raises TrajectoryError: no unseen trajectory keeps the robot's limits.
    """
    values = checked_loop_parameters(robot, parameters, scenario.model.drive_law)
    plant = build_plant(scenario, robot, seed)
    times = scenario.timing.frame_times(scenario.validation.duration_s)
    references = [path.reference(times) for path in unseen_trajectories(robot, scenario, seed)]
    model = [model_run(robot, scenario, values, reference) for reference in references]
    return np.array(model) - np.array([plant.run(reference).pose for reference in references])
