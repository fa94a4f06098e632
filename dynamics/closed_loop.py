"""The sampled closed loop: visual servo (eq. 30) around joint PID (eq. 31) around the robot (eq. 40).

Every frame the pose is measured, by the sensor that the caller passes or by an ideal one; the servo turns it into a
command after the latency, and the command is held until the next. Unless a start is given the run starts at rest at the
first reference pose, in equilibrium: integrators hold what keeps the robot there. One function serves plant and model.

Two implementations, tested to be equal: compiled C (see `closed_loop.h`) and plain Python (`plain_closed_loop.py`).
"""

import numpy as np

from dynamics import compiled_closed_loop, plain_closed_loop
from dynamics.arrays import check_type, flag, floats, mask, real, shown
from dynamics.closed_loop_run import ClosedLoopRun, LoopFailure
from dynamics.errors import SimulationError
from dynamics.joint_elasticity import JointElasticity
from dynamics.loop_types import (
    PARAMETER_COUNT,
    Controller,
    FrameTiming,
    FrictionLaw,
    LoopProblem,
    LoopSettings,
    PoseSensor,
    RateSensor,
    Reference,
    ServoGains,
    StartState,
    checked_latencies,
)
from dynamics.parameters import JOINT_PID_NAMES, check_parameters
from dynamics.robot import Robot

__all__ = [
    "ClosedLoopRun",
    "Controller",
    "FrameTiming",
    "FrictionLaw",
    "JointElasticity",
    "LoopFailure",
    "LoopSettings",
    "PoseSensor",
    "RateSensor",
    "Reference",
    "ServoGains",
    "StartState",
    "equilibrium",
    "prepare",
    "simulate",
]


def simulate(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: PoseSensor | RateSensor | None = None,
    *,
    start: StartState | None = None,
    sensitivities: bool = False,
    start_sensitivities: bool = False,
    commands: np.ndarray | None = None,
    lost: np.ndarray | None = None,
    noise: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    servo_robot: Robot | None = None,
    controller: Controller | None = None,
    compiled: bool | None = None,
) -> ClosedLoopRun:
    """Run the closed loop for parameters (67,): the 64 dynamic ones, then lp, li, ld.

    sensor: None for the ideal one. start: None for the equilibrium at the first reference pose, which moves with the
    parameters. sensitivities: also derivatives of the poses and of the last frame's state with respect to all
    parameters; start_sensitivities: those and the ones with respect to the start (ideal sensor only).
    commands (frames, 6): drive the joints with these instead of the servo's; what is measured is then recorded and
    steers nothing.
    latencies (frames,), s: of each frame's command, instead of the settings' for all; see `command_schedule`.
    servo_robot: the robot whose kinematics the servo knows, where that is another (no sensitivities then).
    controller: takes the place of the servo: (frame, time s, measured pose (6,), desired pose (6,), desired rate (6,))
    -> joint command (6,), rad, at every frame that is measured; the run takes the plain path.
    lost (frames,) bool: frames at which the ideal sensor measures nothing, so that a model loses what its plant lost.
    noise (frames, 6), m and rad: added to the poses that the ideal sensor measures elsewhere.
    compiled: None takes the compiled path when a C compiler is at hand; False forces the plain path.
    Raises LoopFailure when the robot leaves the reachable set (an unstable loop); and before the run
    UnreachablePoseError where reference or start do, ParameterError, SimulationError, SingularPoseError.
    """
    _check_kinds(robot, reference, settings, sensor)
    start_sensitivities = flag("start_sensitivities", start_sensitivities, SimulationError)
    sensitivities = flag("sensitivities", sensitivities, SimulationError) or start_sensitivities
    compiled = None if compiled is None else flag("compiled", compiled, SimulationError)
    if sensor is not None and sensitivities:
        raise SimulationError("sensitivities need the ideal sensor: pass sensor=None")
    if sensor is not None and lost is not None:
        raise SimulationError("lost is for the ideal sensor: a sensor returns None at the frames that it loses")
    if commands is not None:
        commands = np.ascontiguousarray(floats("commands", commands, reference.poses.shape, error=SimulationError))
    if lost is not None:
        lost = mask("lost", lost, len(reference.poses), SimulationError).astype(np.int8)
    if noise is not None:
        noise = _checked_noise(noise, reference, sensor)
    if latencies is not None:
        latencies = checked_latencies(latencies, len(reference.poses), settings.timing)
    if servo_robot is not None:
        check_type("servo_robot", servo_robot, Robot, SimulationError)
        if sensitivities:
            raise SimulationError("sensitivities need a servo that knows the robot: pass servo_robot=None")
    if settings.elasticity is not None and sensitivities:
        raise SimulationError("sensitivities are those of rigid joints: pass settings with elasticity=None")
    if controller is not None:
        compiled = _check_controller(controller, sensitivities, commands, compiled)
    reference.check_reach(robot)
    parameters = _check_loop_parameters(parameters)
    if start is None:
        start = equilibrium(robot, parameters, reference.poses[0], settings.servo, servo_robot, settings.elasticity)
    else:
        check_type("start", start, StartState, SimulationError)
        _check_start_pose(robot, parameters, start.pose)
    _check_elasticity(robot, parameters, settings, start)
    problem = LoopProblem(
        robot,
        parameters,
        reference,
        settings,
        start,
        sensor,
        sensitivities,
        start_sensitivities,
        commands,
        lost,
        noise,
        latencies,
        servo_robot or robot,
        controller,
    )
    library = compiled_closed_loop.library(robot.geometry) if compiled in (None, True) else None
    if library is not None:
        return compiled_closed_loop.run(library, problem)
    if compiled:
        raise SimulationError("compiled=True, but no C compiler was found")
    return plain_closed_loop.run(robot, problem)


def _checked_noise(noise: np.ndarray, reference: Reference, sensor: object) -> np.ndarray:
    if sensor is not None:
        raise SimulationError("noise is for the ideal sensor: a sensor that is given adds its own")
    return np.ascontiguousarray(floats("noise", noise, reference.poses.shape, error=SimulationError))


def prepare(robot: Robot) -> bool:
    """Compile the loop of a robot if that has not been done; False where no C compiler is at hand."""
    check_type("robot", robot, Robot, SimulationError)
    return compiled_closed_loop.library(robot.geometry) is not None


def equilibrium(
    robot: Robot,
    parameters: np.ndarray,
    pose: np.ndarray,
    servo: ServoGains,
    servo_robot: Robot | None = None,
    elasticity: JointElasticity | None = None,
) -> StartState:
    """State of rest at a pose (6,), friction unloaded, for parameters (67,); servo_robot as in `simulate`.

    The holding torque is linear in the dynamic parameters. Raises what `simulate` raises before a run.
    """
    check_type("robot", robot, Robot, SimulationError)
    check_type("servo", servo, ServoGains, SimulationError)
    parameters, pose = _check_loop_parameters(parameters), floats("pose", pose, (6,))
    li, rest = parameters[65], np.zeros(6)
    _check_start_pose(robot, parameters, pose)
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


def _check_elasticity(robot: Robot, parameters: np.ndarray, settings: LoopSettings, start: StartState) -> None:
    elasticity = settings.elasticity
    if elasticity is None:
        return
    if start.motor_angle is None or start.motor_rate is None:
        raise SimulationError("a start with elastic joints needs motor_angle and motor_rate")
    period = 1 / settings.timing.frame_rate_hz
    steps = elasticity.steps_needed(robot, parameters, start.pose, period, settings.friction)
    if settings.steps_per_frame < steps:
        raise SimulationError(
            f"steps_per_frame is {settings.steps_per_frame}, must be >= {steps} to follow joints with "
            f"a stiffness of {elasticity.stiffness:g} N m/rad"
        )


def _check_controller(
    controller: object, sensitivities: bool, commands: np.ndarray | None, compiled: bool | None
) -> bool:
    """Raise SimulationError for what does not go with a controller; returns `compiled`: False."""
    if not callable(controller):
        raise SimulationError(f"controller must be a function, or None for the servo, got {shown(controller)}")
    if sensitivities or commands is not None:
        other = "sensitivities are those of the servo" if sensitivities else "commands take the place of any controller"
        raise SimulationError(f"{other}: pass controller=None")
    if compiled:
        raise SimulationError("a controller runs on the plain path: pass compiled=None or False")
    return False


def _check_loop_parameters(parameters: np.ndarray) -> np.ndarray:
    values = floats("loop parameters", parameters, (PARAMETER_COUNT,), error=SimulationError, finite=False)
    check_parameters(values[:64])
    lp, li, ld = JOINT_PID_NAMES
    for name, value in ((lp, values[64]), (ld, values[66])):
        real(name, value, SimulationError, least=0)
    real(li, values[65], SimulationError, above=0)
    return values


def _check_start_pose(robot: Robot, parameters: np.ndarray, pose: np.ndarray) -> None:
    robot.static_torque(pose, parameters[:64])  # refuses a pose out of reach or singular, with the evidence
    robot.pose_rate(pose, np.zeros(6))  # refuses Euler angles at their singularity


def _check_kinds(robot: Robot, reference: Reference, settings: LoopSettings, sensor: object) -> None:
    for name, value, kind in (("robot", robot, Robot), ("reference", reference, Reference)):
        check_type(name, value, kind, SimulationError)
    check_type("settings", settings, LoopSettings, SimulationError)
    if sensor is not None and not callable(sensor) and not isinstance(sensor, RateSensor):
        raise SimulationError(f"sensor must be a function of frame, time and pose, or None, got {shown(sensor)}")
