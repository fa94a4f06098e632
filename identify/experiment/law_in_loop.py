"""Preparation of a model-based control law, by which a scenario's plant follows a motion."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dynamics.closed_loop import DriveName, EveryFrame
from dynamics.control.gains import check_torque_gains
from dynamics.control.inverse_dynamics import GUESSED_DOUBT, Model, Motion
from dynamics.control.law_interface import Assignment, Feedback, Law, LawInLoop
from dynamics.errors import DynamicsError, SimulationError
from dynamics.workspace import check_motion
from identify.arrays import Array
from identify.errors import ScenarioError, TrajectoryError
from identify.experiment.plant import Plant
from identify.experiment.sensor_in_loop import SensorInLoop
from identify.own_parts import LAWS, PluginFunction, chosen, is_plugin_name
from identify.scenario import Timing
from identify.scenario.loop_sections import Control
from identify.scenario.plant_sections import FILTERED

# Default bandwidth of computed_torque with an observer, times the frame period. The gains can then
# double before the loop becomes unstable. With the noise of the built-in sensors, a slower loop has
# larger tracking errors.
FASTEST = 1.0

# Default bandwidth of computed_torque without an observer, times the delay of the torque. The delay
# is the sum of the latency, half a frame of hold, and one frame of difference quotient.
FASTEST_UNSEEN = 0.5


@dataclass(frozen=True)
class NamedMotion:
    """Motion with its name in messages and its duration, s."""

    name: str
    motion: Motion
    duration_s: float


@dataclass(frozen=True)
class LoopSensor:
    """Measurement in the loop.

    Attributes
    ----------
    measure : callable
        Function ``measure(frame, t, pose, rate)`` like `SensorInLoop.measure`.
    noise : callable
        Function of a frame's number that returns the covariance (6, 6) of the noise of its pose.
    common : ndarray, shape (6, 6)
        Covariance of the error that all poses have in common.
    """

    measure: Callable[[int, float, Array, Array], Array | None]
    noise: Callable[[int], Array]
    common: Array = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True)
class KnownModel:
    """Robot as a control law knows it.

    Attributes
    ----------
    parameters : ndarray, shape (p,)
        Parameters of the law's model, SI.
    drive : DriveName, optional
        Law of the drives. The default is the law in the scenario's model.
    doubt : float
        Expected rate at which errors of torques change, relative to the torque at rest, 1/s.
    """

    parameters: Array
    drive: DriveName | None = None
    doubt: float = GUESSED_DOUBT


def by_images(eye: SensorInLoop) -> LoopSensor:
    """Return the measurement by a sensor with images."""
    return LoopSensor(eye.measure, lambda frame: eye.covariances[frame], eye.common)


def prepared(
    plant: Plant,
    law: str,
    known: KnownModel,
    motion: NamedMotion,
    seen: LoopSensor,
    latencies: Array | None = None,
) -> LawInLoop:
    """Prepare a law to follow a motion.

    plant                Plant that shall follow the motion.
    law                  Name of the law, or ``module:function``.
    known                Robot as the law knows it.
    motion               Motion to follow.
    seen                 Measurement in the loop.
    latencies (frames,)  Latencies of the commands, s, that the law knows. The default is the
                         latency of the timing.

    Raises ScenarioError if the law is unknown or returns no `LawInLoop`, if it needs torque
    commands but the drives do not accept them, or if the actuators cannot hold the platform. Raises
    TrajectoryError if the motion leaves the robot's reach or a joint's travel. The message names
    the time and the leg. Raises SimulationError if the gains are unstable with this model, or a
    user's own law fails.
    """
    loop = plant.loop
    timing = plant.runs.timing
    robot = plant.nominal
    chosen_law: Law = _plugin_law(law, chosen(law, "law", LAWS))
    times = timing.frame_times(motion.duration_s)
    desired = motion.motion.pose(times)
    try:
        check_motion(robot, desired, times, **plant.runs.limits)
    except DynamicsError as error:
        raise TrajectoryError(f"the robot cannot follow {motion.name}: {error}") from error
    settings = loop.side.settings
    if known.drive is not None:
        filter_time = loop.filter_time if known.drive == FILTERED else None
        settings = replace(
            settings, drives=replace(settings.drives, law=known.drive, filter_time=filter_time)
        )
    model = Model(robot, known.parameters, settings.friction, known.doubt)
    gains = feedback(loop.control, timing)
    usual = np.full(len(times), timing.latency_s)
    in_loop = chosen_law(
        Assignment(
            model=model,
            motion=motion.motion,
            frames=len(times),
            settings=settings,
            feedback=gains,
            holding=plant.holding(desired[0]),
            latencies=usual if latencies is None else latencies,
            noise=seen.noise,
            common=seen.common,
        )
    )
    if not isinstance(in_loop, LawInLoop):
        raise ScenarioError(
            f"law {law!r} must return a LawInLoop, returned {type(in_loop).__name__}"
        )
    if in_loop.drives.torques and not loop.control.torque_access:
        raise ScenarioError(
            f"law {law} sets torques, but the drives of {robot.name} do not accept them: "
            "control.torque_access = false; feedforward needs only joint commands"
        )
    # The feedback of this law uses the model, so a wrong model can make it unstable.
    if law == "computed_torque":
        check_torque_gains(model, settings, desired[0], gains)
    if isinstance(in_loop.controller, EveryFrame):
        return replace(in_loop, controller=EveryFrame(_plugin_law(law, in_loop.controller.command)))
    return replace(in_loop, controller=in_loop.controller and _plugin_law(law, in_loop.controller))


def _plugin_law(law: str, asked: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a law. Errors of a user's own function are reported in one line."""
    return PluginFunction(f"law {law!r}", asked, SimulationError) if is_plugin_name(law) else asked


def feedback(control: Control, timing: Timing) -> Feedback:
    """Return the bandwidth, damping and observer setting for computed_torque."""
    period = timing.frame_period_s
    delay = timing.latency_s + 1.5 * period
    fastest = FASTEST / period if control.observer else FASTEST_UNSEEN / delay
    return Feedback(control.bandwidth_rad_s or fastest, control.damping, control.observer)
