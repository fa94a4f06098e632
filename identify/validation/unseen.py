"""Plant and models on trajectories that were not used for the estimate (section 4.3)."""

from __future__ import annotations

import math
import multiprocessing
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.sharedctypes import Synchronized

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

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
from identify.arrays import Array
from identify.estimation.common_error_estimates import errors_of_run
from identify.excitation.design import DesignTask, validation_trajectories
from identify.experiment.plant import Plant
from identify.experiment.run import Experiment, run_plant
from identify.experiment.sensor_in_loop import SensorPlan
from identify.model.from_record import predicting_model
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.progress import Advance, Progress
from identify.record.conditions import SERVO, logged_latencies, recorded_law
from identify.record.recording import is_timed, recorded_reference
from identify.runtime import cores, mapped
from identify.trajectory import FourierTrajectory

MOST_FITS = 12
"""Largest number of linear fits of the starts and the clock, if a record begins in motion."""

SETTLED = 0.99
"""Ratio of the costs of two successive fits above which no further fit is made."""

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
    arguments = (plant, sensor, taught, duration_s, seed)
    workers = workers or cores()
    numbers = range(1, len(trajectories) + 1)
    frames = plant.runs.timing.frames(duration_s) * len(trajectories)
    with progress.stage("validate", frames) as advance:
        # For a single process no pool is needed.
        if workers == 1 or len(trajectories) == 1:
            worker = _Worker(*arguments)
            return [
                worker.run(number, path, advance)
                for number, path in zip(numbers, trajectories, strict=True)
            ]
        context = multiprocessing.get_context("spawn")
        # Workers count frames here, because a callback cannot reach another process.
        counter: Synchronized[int] = context.Value("q", 0)
        start = partial(_start_worker, counter, *arguments)
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
    """Return the poses (N, 6) of the model on a reference. All are NaN if the loop is unstable.

    ``latencies`` (N,) [s] are the latencies of the commands, by default the latency of the timing.
    ``lost`` (N,) marks frames in which the servo measures nothing, by default none.

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
    model. A model that begins in motion gets the starts and the clock that fit the record best.

    Raises the errors of `model_run` and `predicting_model`.
    """
    if recorded_law(record) == SERVO and not is_timed(record):
        latencies = logged_latencies(record, side.timing)
        reference = recorded_reference(record)
        lost = record["measured_ok"].values == 0
        return model_run(side.robot, side.settings, parameters, reference, latencies, lost)
    run = predicting_model(record, side).driven_by_commands()
    try:
        if run.begins_in_motion:
            run = _with_fitted_start(run, parameters)
        return run.simulate(parameters).pose
    except LoopFailure:
        return np.full_like(run.measured, np.nan)


def _with_fitted_start(run: LoopModel, parameters: Array) -> LoopModel:
    """Return a model that begins in motion, with the starts and the clock that fit its record best.

    Without these, a model with the right parameters would be wrong after each start. Each fit is
    linear, but stick-slip of the joints is not. Fits are therefore repeated until the cost hardly
    falls (SETTLED), at most MOST_FITS times.
    """
    cost = math.inf
    for _ in range(MOST_FITS):
        missed = run.noise_residuals(parameters)
        before, cost = cost, float(np.sum(missed**2))
        if cost > SETTLED * before:
            break
        fitted = errors_of_run(run.with_common_errors(parameters), parameters)
        run = run.having(fitted[: len(run.errors_had)])
    return run


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
    """Report the workers' count as progress until the block ends."""
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


def errors_of_model(parameters: ArrayLike, plant: Plant, design: DesignTask, seed: int) -> Array:
    """Return the pose errors (runs, N, 6) [m, rad] of a model against the plant.

    Both run on the validation trajectories of a seed, each with its own friction law and
    integration steps. An ideal sensor closes both loops, so the errors are caused only by the
    parameters (p,) and by effects that the model lacks. The errors of a run are NaN if, and only
    if, the model's loop is unstable.

    Raises dynamics.DynamicsError for parameters of another shape, not finite, or outside their
    range. Raises TrajectoryError if too few random trajectories are within the robot's limits.
    """
    robot = plant.nominal
    settings = plant.loop.side.settings
    values = checked_loop_parameters(robot, parameters, settings.drives.law)
    times = plant.runs.timing.frame_times(design.validation.duration_s)
    references = [path.reference(times) for path in validation_trajectories(design, seed)]
    model = [model_run(robot, settings, values, reference) for reference in references]
    return np.array(model) - np.array([plant.run(reference).pose for reference in references])
