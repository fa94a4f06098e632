"""What a closed-loop run is refused for before it begins, and the state of rest from which it starts."""

import numpy as np

from dynamics.checks import check_type, floats, mask, real, shown
from dynamics.closed_loop.elasticity import JointElasticity
from dynamics.closed_loop.problem import (
    PARAMETER_COUNT,
    LoopProblem,
    LoopSettings,
    RateSensor,
    Reference,
    ServoGains,
    StartState,
)
from dynamics.errors import SimulationError
from dynamics.parameters import JOINT_PID_NAMES, check_parameters
from dynamics.robot import Robot

# What a closed-loop run is refused for before it begins: values that are none, and options that exclude each other.


def check_kinds(
    robot: Robot,
    reference: Reference,
    settings: LoopSettings,
    sensor: object,
    servo_robot: Robot | None,
    controller: object,
) -> None:
    """Raise SimulationError for parts of a run that are not what they are called."""
    check_type("robot", robot, Robot, SimulationError)
    check_type("reference", reference, Reference, SimulationError)
    check_type("settings", settings, LoopSettings, SimulationError)
    if sensor is not None and not callable(sensor) and not isinstance(sensor, RateSensor):
        raise SimulationError(f"sensor must be a function of frame, time and pose, or None, got {shown(sensor)}")
    if servo_robot is not None:
        check_type("servo_robot", servo_robot, Robot, SimulationError)
    if controller is not None and not callable(controller):
        raise SimulationError(f"controller must be a function, or None for the servo, got {shown(controller)}")


def checked_loop_parameters(parameters: object) -> np.ndarray:
    """The 64 dynamic parameters and lp, li, ld (67,). Raises SimulationError, or ParameterError for a dynamic one."""
    values = floats("loop parameters", parameters, (PARAMETER_COUNT,), error=SimulationError, finite=False)
    check_parameters(values[:64])
    lp, li, ld = JOINT_PID_NAMES
    for name, value in ((lp, values[64]), (ld, values[66])):
        real(name, value, SimulationError, least=0)
    real(li, values[65], SimulationError, above=0)
    return values


def checked_rows(name: str, rows: object, frames: int) -> np.ndarray | None:
    """Rows (frames, 6) as C doubles; None stays None. Raises SimulationError."""
    return None if rows is None else np.ascontiguousarray(floats(name, rows, (frames, 6), error=SimulationError))


def checked_lost(lost: object, frames: int) -> np.ndarray | None:
    """Lost frames (frames,) as C bytes; None stays None. Raises SimulationError."""
    return None if lost is None else mask("lost", lost, frames, SimulationError).astype(np.int8)


def check_start_pose(robot: Robot, parameters: np.ndarray, pose: np.ndarray) -> None:
    """Raise UnreachablePoseError or SingularPoseError for a pose (6,) from which no run can start."""
    robot.static_torque(pose, parameters[:64])  # refuses a pose out of reach or singular, with the evidence
    robot.pose_rate(pose, np.zeros(6))  # refuses Euler angles at their singularity


def check_together(problem: LoopProblem, servo_robot: Robot | None, compiled: bool | None) -> None:
    """Raise SimulationError for options of a run that exclude each other; servo_robot as the caller gave it."""
    sensed, controlled = problem.sensor is not None, problem.controller is not None
    for excluded, words in (
        (sensed and problem.sensitivities, "sensitivities need the ideal sensor: pass sensor=None"),
        (
            sensed and problem.lost is not None,
            "lost is for the ideal sensor: a sensor returns None at the frames that it loses",
        ),
        (
            sensed and problem.noise is not None,
            "noise is for the ideal sensor: a sensor that is given adds its own",
        ),
        (
            problem.sensitivities and servo_robot is not None,
            "sensitivities need a servo that knows the robot: pass servo_robot=None",
        ),
        (
            problem.sensitivities and problem.settings.elasticity is not None,
            "sensitivities are those of rigid joints: pass settings with elasticity=None",
        ),
        (controlled and problem.sensitivities, "sensitivities are those of the servo: pass controller=None"),
        (
            controlled and problem.commands is not None,
            "commands take the place of any controller: pass controller=None",
        ),
        (controlled and compiled, "a controller runs on the plain path: pass compiled=None or False"),
    ):
        if excluded:
            raise SimulationError(words)


def check_elasticity(problem: LoopProblem) -> None:
    """Raise SimulationError where elastic joints have no start of their motors, or steps too long to follow them."""
    elasticity, start, settings = problem.settings.elasticity, problem.start, problem.settings
    if elasticity is None:
        return
    if start.motor_angle is None or start.motor_rate is None:
        raise SimulationError("a start with elastic joints needs motor_angle and motor_rate")
    steps = elasticity.steps_needed(problem.robot, problem.parameters, start.pose, problem.period, settings.friction)
    if settings.steps_per_frame < steps:
        raise SimulationError(
            f"steps_per_frame is {settings.steps_per_frame}, must be >= {steps} to follow joints with "
            f"a stiffness of {elasticity.stiffness:g} N m/rad"
        )


# The state of rest from which a closed-loop run starts where no other start is given.


def equilibrium(
    robot: Robot,
    parameters: np.ndarray,
    pose: np.ndarray,
    servo: ServoGains,
    servo_robot: Robot | None = None,
    elasticity: JointElasticity | None = None,
) -> StartState:
    """State of rest at a pose (6,), friction unloaded, for parameters (67,); servo_robot as in `closed_loop.simulate`.

    The holding torque is linear in the dynamic parameters. Raises what that raises before a run.
    """
    check_type("robot", robot, Robot, SimulationError)
    check_type("servo", servo, ServoGains, SimulationError)
    parameters, pose = checked_loop_parameters(parameters), floats("pose", pose, (6,))
    li, rest = parameters[65], np.zeros(6)
    check_start_pose(robot, parameters, pose)
    angles = robot.inverse_kinematics(pose)
    torque_map = np.linalg.solve(robot.joint_jacobian(pose).T, robot.regressor(pose, rest, rest))
    integral = torque_map @ parameters[:64] / li
    sensitivity = np.zeros((6, PARAMETER_COUNT))
    sensitivity[:, :64] = torque_map / li
    sensitivity[:, 65] = -integral / li
    motors = {}
    if elasticity is not None:
        angles = angles + li * integral / elasticity.stiffness
        motors = {"motor_angle": angles, "motor_rate": rest}
    known = servo_robot or robot
    servo_integral = np.linalg.solve(known.pose_jacobian(pose), angles) / servo.ki if servo.ki else np.zeros(6)
    return StartState(pose, rest, integral, servo_integral, angles[None], pose, sensitivity, **motors)
