"""One run of a robot that follows a motion under a law with a model, by the sensor or by what stands for it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynamics.closed_loop import ClosedLoopRun, DriveName, RateSensor, Reference
from dynamics.control.gains import check_torque_gains
from dynamics.control.inverse_dynamics import Model
from dynamics.control.law import Assignment, Feedback, Law, LawInLoop
from dynamics.errors import DynamicsError
from dynamics.workspace import check_motion
from identify.arrays import Array
from identify.errors import ScenarioError, TrajectoryError
from identify.experiment.plant import Plant
from identify.experiment.sensor_in_loop import SensorInLoop
from identify.loop_parameters import model_settings
from identify.plugins import LAWS, chosen
from identify.scenario import Scenario
from identify.scenario.sections import FILTERED
from identify.tracking.motions import NamedMotion

FASTEST = 0.5
"""Bandwidth of computed_torque with an observer, times the time between two frames: its gains may then double."""

FASTEST_UNSEEN = 0.5
"""The same without, times the delay from the motion to its torque: the latency, half a frame of hold, one frame of
difference."""


@dataclass(frozen=True)
class Seen:
    """By what the loop sees: measure(frame, t, pose, rate) as `SensorInLoop` does, and the covariance (6, 6) of the
    noise of a frame's pose."""

    measure: Callable[[int, float, Array, Array], Array | None]
    noise: Callable[[int], Array]


@dataclass(frozen=True)
class Followed:
    """A run: its loop, what was desired of it (N, 6), and what the observer expected of each frame before it saw it:
    the coordinates (N, m) and their covariances (N, m, m), None without."""

    run: ClosedLoopRun
    desired: Array
    expected: tuple[Array, Array] | None
    torque_limit: float | None

    @property
    def errors(self) -> Array:
        """True less desired poses (N, 6), m and rad."""
        return self.run.pose - self.desired

    @property
    def saturated(self) -> int:
        """Frames at which an actuator gave all that it has."""
        limit = self.torque_limit
        return 0 if limit is None else int((np.abs(self.run.torque) >= limit * (1 - 1e-12)).any(axis=1).sum())

    def normalised_squared_error(self, coordinates: Array, common: Array) -> float | None:
        """Mean e^T P^-1 e / m of what the observer expected of the true coordinates (N, m); None without observer.
        common (m, m): covariance of what all measured poses have in common, which no observer can find."""
        if self.expected is None:
            return None
        errors = coordinates - self.expected[0]
        weighted = np.linalg.solve(self.expected[1] + common, errors[..., None])[..., 0]
        return float(np.mean(np.sum(errors * weighted, axis=1)) / errors.shape[1])


def by_images(eye: SensorInLoop) -> Seen:
    """By the sensor."""
    return Seen(eye.measure, lambda frame: eye.covariances[frame])


def by_drawing(covariance: Array, lost: NDArray[np.bool_], rng: np.random.Generator, exact: bool = False) -> Seen:
    """By poses drawn about the true ones with a covariance (6, 6), none at lost frames (N,); or by the true ones."""
    factor = np.linalg.cholesky(covariance)
    drawn = rng.standard_normal((len(lost), 6)) @ factor.T

    def measure(frame: int, t: float, pose: Array, rate: Array) -> Array | None:
        if exact:
            return pose
        return None if lost[frame] else np.asarray(pose + drawn[frame])

    return Seen(measure, lambda frame: covariance)


def follow(
    plant: Plant,
    law: str,
    parameters: Array,
    motion: NamedMotion,
    seen: Seen,
    latencies: Array | None = None,
    drive: DriveName | None = None,
) -> Followed:
    """Follow a motion under a law with a model of these parameters (p,); latencies (N,), s, where they vary; drive: the
    law of its drives, where that is not the scenario's model's.

    Raises what `prepared` does, and LoopFailure: a loop that is lost.
    """
    in_loop = prepared(plant, law, parameters, motion, seen, latencies, drive)
    times = plant.scenario.timing.frame_times(motion.duration_s)
    reference = Reference(motion.motion.pose(times), motion.motion.pose_rate(times))
    run = plant.run(reference, RateSensor(seen.measure), latencies, law=in_loop)
    expected = None
    if in_loop.expected:
        means = np.array([estimate.coordinates for estimate in in_loop.expected])
        expected = means, np.array([estimate.covariance for estimate in in_loop.expected])
    return Followed(run, reference.poses, expected, in_loop.drives.torque_limit)


def prepared(
    plant: Plant,
    law: str,
    parameters: Array,
    motion: NamedMotion,
    seen: Seen,
    latencies: Array | None = None,
    drive: DriveName | None = None,
) -> LawInLoop:
    """A law ready to follow a motion.

    Raises ScenarioError: a law that is none, or needs torques which the drives do not take. Raises TrajectoryError: a
    motion beyond reach or travel, with time and leg. Raises SimulationError: gains that are unstable with this model.
    """
    scenario, robot = plant.scenario, plant.nominal
    chosen_law: Law = chosen(law, "law", LAWS)
    times = scenario.timing.frame_times(motion.duration_s)
    desired = motion.motion.pose(times)
    try:
        check_motion(robot, desired, times, **scenario.excitation.singularity_limits)
    except DynamicsError as error:
        raise TrajectoryError(f"the robot may not follow {motion.name}: {error}") from error
    settings = model_settings(robot, scenario)
    if drive is not None:
        known = scenario.model.derivative_filter_s or scenario.plant.derivative_filter_s
        filter_time = known if drive == FILTERED else None
        settings = replace(settings, drives=replace(settings.drives, law=drive, filter_time=filter_time))
    model, asked = Model(robot, parameters, settings.friction), feedback(scenario)
    usual = np.full(len(times), scenario.timing.latency_s)
    found = chosen_law(
        Assignment(
            model=model,
            motion=motion.motion,
            frames=len(times),
            settings=settings,
            feedback=asked,
            holding=plant.robot.static_torque(desired[0], plant.parameters[plant.robot.layout.dynamic]),
            latencies=usual if latencies is None else latencies,
            noise=seen.noise,
        )
    )
    if not isinstance(found, LawInLoop):
        raise ScenarioError(f"law {law!r} must return a LawInLoop, returned {type(found).__name__}")
    if found.drives.torques and not scenario.control.torque_access:
        raise ScenarioError(
            f"law {law} sets torques, which the drives of {robot.name} do not take: control.torque_access = false; "
            "feedforward needs joint commands only"
        )
    if law == "computed_torque":
        check_torque_gains(model, settings, desired[0], asked)
    return found


def feedback(scenario: Scenario) -> Feedback:
    """What a scenario asks of the loop of computed_torque."""
    control, timing = scenario.control, scenario.timing
    period = timing.frame_period_s
    delay = timing.latency_s + 1.5 * period
    fastest = FASTEST / period if control.observer else FASTEST_UNSEEN / delay
    return Feedback(control.bandwidth_rad_s or fastest, control.damping, control.observer)
