"""The sampled closed loop: visual servo (eq. 30) around joint PID (eq. 31) around the robot (eq. 40).

Every frame the pose is measured, by the sensor that the caller passes or by an ideal one; the servo turns it into a
command after the latency, and the command is held until the next. The run starts at rest at the first reference pose,
in equilibrium: integrators hold what keeps the robot there. One function serves plant and model.

Two implementations, tested to be equal: compiled C (`closed_loop.c`) and plain Python (`plain_closed_loop.py`).
"""

import numpy as np

from dynamics import compiled_closed_loop, plain_closed_loop
from dynamics.errors import SimulationError
from dynamics.loop_types import (
    PARAMETER_COUNT,
    ClosedLoopRun,
    FrameTiming,
    FrictionLaw,
    LoopFailure,
    LoopProblem,
    LoopSettings,
    PoseSensor,
    Reference,
    ServoGains,
    StartState,
)
from dynamics.parameters import check_parameters
from dynamics.robot import Robot

__all__ = [
    "ClosedLoopRun",
    "FrameTiming",
    "FrictionLaw",
    "LoopFailure",
    "LoopSettings",
    "PoseSensor",
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
    sensor: PoseSensor | None = None,
    *,
    sensitivities: bool = False,
    commands: np.ndarray | None = None,
    lost: np.ndarray | None = None,
    compiled: bool | None = None,
) -> ClosedLoopRun:
    """Run the closed loop for parameters (67,): the 64 dynamic ones, then lp, li, ld.

    sensor: None for the ideal one. sensitivities: also derivatives of the poses with respect to all parameters
    (ideal sensor or logged commands only). commands (frames, 6): drive the joints with these instead of the servo's.
    lost (frames,) bool: frames at which the ideal sensor measures nothing, so that a model loses what its plant lost.
    compiled: None takes the compiled path when a C compiler is at hand; False forces the plain path.
    Raises LoopFailure when the robot leaves the reachable set (an unstable loop), ParameterError, SimulationError.
    """
    parameters = _check_loop_parameters(parameters)
    if sensitivities and sensor is not None:
        raise SimulationError("sensitivities need the ideal sensor: pass sensor=None")
    if commands is not None:
        commands = np.ascontiguousarray(commands, dtype=float)
        if commands.shape != reference.poses.shape or not np.isfinite(commands).all():
            raise SimulationError(f"commands must be finite with shape {reference.poses.shape}, got {commands.shape}")
    if lost is not None:
        lost = np.ascontiguousarray(lost, dtype=np.int8)
        if lost.shape != (len(reference.poses),) or sensor is not None:
            raise SimulationError(
                f"lost must have shape ({len(reference.poses)},) and goes with the ideal sensor only, got {lost.shape}"
            )
    library = compiled_closed_loop.library(robot.geometry) if compiled in (None, True) else None
    start = equilibrium(robot, parameters, reference.poses[0], settings.servo)
    problem = LoopProblem(robot, parameters, reference, settings, start, sensor, sensitivities, commands, lost)
    if library is not None:
        return compiled_closed_loop.run(library, problem)
    if compiled:
        raise SimulationError("compiled=True, but no C compiler was found")
    return plain_closed_loop.run(robot, problem)


def prepare(robot: Robot) -> bool:
    """Compile the loop of a robot if that has not been done; False where no C compiler is at hand."""
    return compiled_closed_loop.library(robot.geometry) is not None


def equilibrium(robot: Robot, parameters: np.ndarray, pose: np.ndarray, servo: ServoGains) -> StartState:
    """State of rest at a pose (6,), friction unloaded. The holding torque is linear in the dynamic parameters."""
    li = parameters[65]
    robot.static_torque(pose, parameters[:64])  # refuses a pose out of reach or singular, with the evidence
    angles = robot.inverse_kinematics(pose)
    rest = np.zeros(6)
    torque_map = np.linalg.solve(robot.joint_jacobian(pose).T, robot.regressor(pose, rest, rest))
    integral = torque_map @ parameters[:64] / li
    sensitivity = np.zeros((6, PARAMETER_COUNT))
    sensitivity[:, :64] = torque_map / li
    sensitivity[:, 65] = -integral / li
    servo_integral = np.linalg.solve(robot.pose_jacobian(pose), angles) / servo.ki if servo.ki else np.zeros(6)
    return StartState(angles, integral, sensitivity, servo_integral)


def _check_loop_parameters(parameters: np.ndarray) -> np.ndarray:
    parameters = np.ascontiguousarray(parameters, dtype=float)
    if parameters.shape != (PARAMETER_COUNT,):
        raise SimulationError(f"loop parameters must have shape ({PARAMETER_COUNT},), got {parameters.shape}")
    check_parameters(parameters[:64])
    for name, value in zip(("lp", "li", "ld"), parameters[64:], strict=True):
        if not np.isfinite(value) or value < 0 or (name == "li" and value == 0):
            limit = "> 0" if name == "li" else ">= 0"
            raise SimulationError(f"joint_pid.{name} is {value}, must be finite and {limit}")
    return parameters
