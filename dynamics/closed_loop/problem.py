"""Closed-loop problem: the checked arguments of a run."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from dynamics.checks import check_type, flag, floats, mask, shown
from dynamics.closed_loop.checked_arguments import (
    checked_directions,
    checked_times,
    held_commands,
    most_directions,
)
from dynamics.closed_loop.loop_settings import (
    Controller,
    EveryFrame,
    FrameTiming,
    IdealSensor,
    LoopSettings,
    RateSensor,
    Reference,
    Sensor,
)
from dynamics.closed_loop.start_state import (
    StartState,
    check_start_pose,
    checked_loop_parameters,
    equilibrium,
)
from dynamics.errors import SimulationError
from dynamics.legs.geometric_numbers import MOST_NUMBERS
from dynamics.parameters import JOINT_PID, RigidGroups
from dynamics.robot import Robot


@dataclass(frozen=True)
class Sizes:
    """Sizes for which kernels are compiled.

    `joints` and `coordinates` are the numbers of joints and coordinates of the robot, and `rigid`
    is the number of parameters of the rigid bodies. `geometry` is the number of entries reserved
    for geometric numbers, the last inputs of the robot's functions (see `Robot.moved`). It is the
    same for most robots, which thus share kernels. `filters` is the number of joints whose drives
    filter a rate. `gains` is the number of gains of the joint PID.
    """

    joints: int
    coordinates: int
    rigid: int
    geometry: int = 0
    filters: int = 0
    gains: int = len(JOINT_PID)

    @property
    def parameters(self) -> int:
        """Number of all parameters: rigid bodies, friction of every joint, joint PID."""
        return self.rigid + 2 * self.joints + self.gains

    @property
    def start(self) -> int:
        """Number of entries of the start state: pose, pose rate, joint integral, servo integral."""
        return 3 * self.coordinates + self.joints


@dataclass(frozen=True)
class LoopProblem:
    """Checked arguments of one run, with its start state.

    Frames are one period apart, or at `times` (frames,), s. With `times`, only frames for which
    `written` (frames,) is True issue a command. Other rows of `commands` repeat the previous row.
    """

    robot: Robot
    parameters: np.ndarray
    reference: Reference
    settings: LoopSettings
    start: StartState
    sensor: Sensor
    latencies: np.ndarray | None
    servo_robot: Robot
    commands: np.ndarray | None = None
    feedforward: np.ndarray | None = None
    controller: Controller | EveryFrame | None = None
    times: np.ndarray | None = None
    written: np.ndarray | None = None
    sensitivities: bool = False
    start_sensitivities: bool = False
    groups: RigidGroups | None = None
    directions: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    start_directions: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def columns(self) -> np.ndarray:
        """Indices (k,) of the parameters with respect to which derivatives are computed."""
        rigid = np.arange(self.sizes.rigid) if self.groups is None else self.groups.pivots
        return np.concatenate([rigid, np.arange(self.sizes.rigid, self.sizes.parameters)])

    @property
    def further_columns(self) -> int:
        """Number of columns after those of the parameters: of the start state, or of directions."""
        return self.sizes.start if self.start_sensitivities else self.directions.shape[2]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.reference.poses)

    @property
    def period(self) -> float:
        """Inverse of the frame rate, s. Ramps, command rates and steps use it with `times`, too."""
        return 1.0 / self.settings.timing.frame_rate_hz

    @cached_property
    def frame_times(self) -> np.ndarray:
        """Times (frames,) of the frames, s."""
        return np.arange(self.frames) * self.period if self.times is None else self.times

    @property
    def ideal(self) -> IdealSensor | None:
        """Ideal sensor of the run, or None for another sensor."""
        return self.sensor if isinstance(self.sensor, IdealSensor) else None

    @property
    def asked(self) -> bool:
        """True if a sensor or controller in Python is called, so that frames run one by one."""
        return self.ideal is None or self.controller is not None

    @cached_property
    def sizes(self) -> Sizes:
        """Sizes of the robot and its drives, for which the kernels of the run are compiled."""
        motion, served = (
            robot.functions["equation_of_motion"] for robot in (self.robot, self.servo_robot)
        )
        return Sizes(
            joints=motion.outputs[2][0],
            coordinates=motion.inputs[0],
            rigid=motion.inputs[2],
            filters=motion.outputs[2][0] if self.settings.drives.filter_time else 0,
            gains=len(self.robot.layout.joint_pid_names),
            geometry=max(
                MOST_NUMBERS * motion.outputs[2][0], len(motion.constants), len(served.constants)
            ),
        )


def servo_problem(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: Sensor,
    servo_robot: Robot | None,
    start: StartState | None,
    feedforward: np.ndarray | None,
    latencies: np.ndarray | None,
) -> LoopProblem:
    """Problem of a run under the servo.

    Raises the errors of `simulate_servo` that arise before the run.
    """
    given = robot, parameters, reference, settings, sensor, start, latencies
    problem = _problem(*given, servo_robot, feedforward)
    if settings.drives.torques:
        raise SimulationError(
            "drives that take torques need a controller or commands: the servo commands joints"
        )
    return problem


def commands_problem(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    commands: np.ndarray,
    sensor: Sensor,
    start: StartState | None,
    latencies: np.ndarray | None,
    times: np.ndarray | None,
) -> LoopProblem:
    """Problem of a run under commands.

    Raises the errors of `simulate_commands` that arise before the run.
    """
    problem = _problem(robot, parameters, reference, settings, sensor, start, latencies)
    shape = problem.frames, robot.layout.joints
    if times is None:
        return dataclasses.replace(problem, commands=_rows("commands", commands, shape))
    held, written = held_commands(commands, shape, problem.start.commands[-1])
    if start is None and not written[0]:
        raise SimulationError("a run whose first frame issues no command needs a start")
    times = checked_times(times, problem.frames)
    return dataclasses.replace(problem, commands=held, times=times, written=written)


def controller_problem(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    controller: Controller | EveryFrame,
    sensor: Sensor,
    start: StartState | None,
    latencies: np.ndarray | None,
) -> LoopProblem:
    """Problem of a run under a control law.

    Raises the errors of `simulate_controller` that arise before the run.
    """
    if not callable(controller) and not isinstance(controller, EveryFrame):
        raise SimulationError(f"controller must be a function, got {shown(controller)}")
    problem = _problem(robot, parameters, reference, settings, sensor, start, latencies)
    return dataclasses.replace(problem, controller=controller)


def with_derivatives(
    problem: LoopProblem,
    by_start: object,
    groups: RigidGroups | None,
    directions: np.ndarray | None = None,
    start_directions: np.ndarray | None = None,
) -> LoopProblem:
    """Problem of a run that also computes derivatives.

    `directions` (frames, n, k) are k directions of the commands of the run. Those of the commands
    before the run are `start_directions` (n, k). Raises SimulationError for elastic joints, for
    directions of a wrong shape or number, and for directions together with `by_start`.
    """
    if groups is not None:
        check_type("groups", groups, RigidGroups, SimulationError)
    if problem.settings.elasticity is not None:
        raise SimulationError(
            "derivatives exist only for rigid joints: pass settings with elasticity=None"
        )
    by_start = flag("by_start", by_start, SimulationError)
    derived = dataclasses.replace(
        problem, sensitivities=True, start_sensitivities=by_start, groups=groups
    )
    if directions is None and start_directions is None:
        return derived
    most = 0 if derived.start_sensitivities else most_directions(problem.robot, groups)
    shape = problem.frames, problem.robot.layout.joints
    moved, before = checked_directions(directions, start_directions, shape, most)
    return dataclasses.replace(derived, directions=moved, start_directions=before)


def _problem(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: Sensor,
    start: StartState | None,
    latencies: np.ndarray | None,
    servo_robot: Robot | None = None,
    feedforward: np.ndarray | None = None,
) -> LoopProblem:
    """Problem with the checked arguments that servo, commands and controllers have in common."""
    check_type("robot", robot, Robot, SimulationError)
    check_type("reference", reference, Reference, SimulationError)
    check_type("settings", settings, LoopSettings, SimulationError)
    if servo_robot is not None:
        check_type("servo_robot", servo_robot, Robot, SimulationError)
        _check_coordinates(robot, servo_robot)
    _check_reach(robot, reference)
    frames = len(reference.poses)
    parameters = checked_loop_parameters(robot, parameters, settings.drives.law)
    # raises an error if the drives have zeros for another number of joints
    settings.drives.zeros(robot.layout.joints)
    feedforward = _rows("feedforward", feedforward, (frames, robot.layout.joints))
    if latencies is not None:
        latencies = floats("latencies", latencies, (frames,), error=SimulationError)
        _check_latencies(settings.timing, "latency of frame", latencies)
    if start is None:
        # bytes, because arrays cannot be keys of a cache
        key = parameters.tobytes(), reference.poses[0].tobytes()
        start = _at_rest(robot, *key, settings, servo_robot, feedforward is not None)
    else:
        _check_start(robot, parameters, settings, start)
    problem = LoopProblem(
        robot,
        parameters,
        reference,
        settings,
        start,
        _checked_sensor(sensor, frames),
        latencies,
        servo_robot or robot,
        feedforward=feedforward,
    )
    _check_elasticity(problem)
    return problem


def _checked_sensor(sensor: Sensor, frames: int) -> Sensor:
    """Checked sensor. Raises SimulationError for another type, or another number of frames."""
    if isinstance(sensor, IdealSensor):
        lost = sensor.lost
        return IdealSensor(
            None if lost is None else mask("lost", lost, frames, SimulationError),
            _rows("noise", sensor.noise, (frames, 6)),
        )
    if not callable(sensor) and not isinstance(sensor, RateSensor):
        raise SimulationError(
            "sensor must be a function of frame, time and pose, or an IdealSensor, got "
            f"{shown(sensor)}"
        )
    return sensor


@lru_cache(maxsize=16)
def _at_rest(
    robot: Robot,
    parameters: bytes,
    pose: bytes,
    settings: LoopSettings,
    servo_robot: Robot | None,
    fed_forward: bool,
) -> StartState:
    """State of rest at a pose (6,).

    The state is cached for further runs of the same model. Hence its arrays are read-only.
    """
    values = np.frombuffer(parameters)
    start = equilibrium(
        robot,
        values,
        np.frombuffer(pose),
        settings.servo,
        servo_robot,
        settings.elasticity,
        fed_forward,
        settings.drives,
    )
    if settings.drives.torques:
        # if the drives take torques, the command at rest is the torque that holds the robot
        torque = robot.static_torque(start.pose, values[robot.layout.dynamic])
        start = dataclasses.replace(start, commands=torque[None])
    for part in vars(start).values():
        if part is not None:
            part.setflags(write=False)
    return start


def _check_start(
    robot: Robot, parameters: np.ndarray, settings: LoopSettings, start: StartState
) -> None:
    """Raise an error if a run cannot start from a state."""
    check_type("start", start, StartState, SimulationError)
    start.check_sizes(robot)
    check_start_pose(robot, parameters, start.pose)
    _check_latencies(settings.timing, "start: latency of command", start.latencies)


@lru_cache(maxsize=64)
def _check_reach(robot: Robot, reference: Reference) -> None:
    """Raise UnreachablePoseError, with frame and leg, for a reference pose out of reach."""
    robot.check_reach(reference.poses, "reference pose", "frame")


def _check_coordinates(robot: Robot, servo_robot: Robot) -> None:
    """Raise SimulationError if two robots have different coordinates."""
    if servo_robot.geometry.chart != robot.geometry.chart:
        raise SimulationError(
            f"servo_robot {servo_robot.name} has other coordinates than {robot.name}"
        )


def _check_latencies(timing: FrameTiming, name: str, latencies: np.ndarray | None) -> None:
    """Raise SimulationError for a latency that is out of range."""
    for number, latency in enumerate([] if latencies is None else latencies.tolist()):
        timing.check_latency(f"{name} {number}", latency)


def _rows(name: str, rows: object, shape: tuple[int, int]) -> np.ndarray | None:
    """Rows as a contiguous array, or None. Raises SimulationError for another shape."""
    if rows is None:
        return None
    return np.ascontiguousarray(floats(name, rows, shape, error=SimulationError))


def _check_elasticity(problem: LoopProblem) -> None:
    """Raise SimulationError if elastic joints have no motor states, or too few steps per frame."""
    settings = problem.settings
    elasticity = settings.elasticity
    start = problem.start
    if elasticity is None:
        return
    if start.motor_angle is None or start.motor_rate is None:
        raise SimulationError("a start with elastic joints needs motor_angle and motor_rate")
    steps = elasticity.steps_needed(
        problem.robot, problem.parameters, start.pose, problem.period, settings.friction
    )
    if settings.steps_per_frame < steps:
        raise SimulationError(
            f"steps_per_frame is {settings.steps_per_frame}, must be >= {steps} to follow joints "
            f"with a stiffness of {elasticity.stiffness:g} N m/rad"
        )
