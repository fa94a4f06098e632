"""The frame loop in plain Python on CasADi's virtual machine: the twin of `closed_loop.c`."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from dynamics.closed_loop.command_schedule import CommandSchedule, command_schedule
from dynamics.closed_loop.joints import MotionFunctions, elastic_functions
from dynamics.closed_loop.motion import Command, State
from dynamics.closed_loop.problem import (
    LENGTH,
    MEASURED_OUT_OF_REACH,
    PARAMETER_COUNT,
    START_COUNT,
    LoopProblem,
    Reference,
    measurement,
    own_command,
)
from dynamics.closed_loop.run import ClosedLoopRun, empty_run, failure
from dynamics.closed_loop.servo import VisualServo
from dynamics.closed_loop.stick_slip import MotionStopped, StickSlipMotion
from dynamics.legs.rss_geometry import Rss6Geometry
from dynamics.rigid_body.equation_of_motion import motion_functions
from dynamics.rigid_body.virtual_work import kinematic_functions
from dynamics.robot import Robot

Issued = tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=16)
def _functions(geometry: Rss6Geometry) -> dict[str, ca.Function]:
    built = motion_functions(geometry) + kinematic_functions(geometry)
    return {function.name(): function for function in built}


def run(robot: Robot, problem: LoopProblem) -> ClosedLoopRun:
    """Do one run in plain Python; see `closed_loop.simulate`."""
    functions: MotionFunctions = _functions(robot.geometry)
    reference, settings, period, start = problem.reference, problem.settings, problem.period, problem.start
    state = State(start.pose, start.pose_rate, start.joint_integral)
    if settings.elasticity is not None:
        assert start.motor_angle is not None
        assert start.motor_rate is not None
        pose, rate = np.append(state.pose, start.motor_angle), np.append(state.rate, start.motor_rate)
        state, functions = State(pose, rate, state.integral), elastic_functions(functions, settings.elasticity)
    tangent, d_servo_integral = _start_tangent(problem)
    rest = np.zeros_like(d_servo_integral)
    motion = StickSlipMotion(
        functions, problem.parameters, settings.friction, tangent if problem.sensitivities else None
    )
    known = _functions(problem.servo_robot.geometry)
    servo = VisualServo(known, settings.servo, period, start.last_measured, start.servo_integral, d_servo_integral)
    result = empty_run(problem)
    issued: list[Issued] = [(command, rest) for command in start.commands]
    schedule = command_schedule(problem)
    motion.start_from(state)
    for frame in range(problem.frames):
        d_pose = _record_state(result, frame, state, motion)
        result.servo_integral[frame] = servo.integral
        if frame + 1 == problem.frames:
            _record_end(result, motion, servo)
        measured = _measure(problem, frame, state)
        servo.next_frame()
        result.measured_ok[frame] = measured is not None
        result.measured[frame] = np.nan if measured is None else measured
        if problem.commands is not None:
            issued.append((problem.commands[frame], rest))
        elif measured is None:
            issued.append(issued[-1])
        elif problem.controller is not None:
            issued.append((own_command(problem.controller, problem, frame, measured), rest))
        else:
            issued.append(_servo_command(servo, frame, reference, measured, d_pose))
        result.command[frame] = issued[-1][0]
        if not np.isfinite(issued[-1][0]).all():
            raise failure(MEASURED_OUT_OF_REACH, frame, problem, state.pose[:6], result.measured)
        try:
            state = _frame(motion, state, issued, frame, problem, schedule, result)
        except MotionStopped as reason:
            raise failure(str(reason), frame, problem, reason.pose[:6], result.measured) from None
    return replace(result, events=motion.events)


def _record_state(result: ClosedLoopRun, frame: int, state: State, motion: StickSlipMotion) -> np.ndarray | None:
    """Write the state at a frame into the result; returns the sensitivity of the pose, if there is one."""
    result.pose[frame], result.pose_rate[frame] = state.pose[:6], state.rate[:6]
    if result.motor_angle is not None and result.motor_rate is not None:
        result.motor_angle[frame], result.motor_rate[frame] = state.pose[6:], state.rate[6:]
    result.joint_integral[frame] = state.integral
    if motion.tangent is None or result.pose_sensitivity is None:
        return None
    result.pose_sensitivity[frame] = motion.tangent.pose[:, :PARAMETER_COUNT]
    if result.start_sensitivity is not None:
        result.start_sensitivity[frame] = motion.tangent.pose[:, LENGTH + 1 :]
    return motion.tangent.pose


def _record_end(result: ClosedLoopRun, motion: StickSlipMotion, servo: VisualServo) -> None:
    """Write the derivatives of the last frame's state into the result, where they are wanted."""
    x = motion.tangent
    if x is None or result.end_sensitivity is None:
        return
    entries = np.vstack([x.pose, x.rate, x.integral, servo.integral_tangent])
    result.end_sensitivity[:] = entries[:, :PARAMETER_COUNT]
    if result.end_start_sensitivity is not None:
        result.end_start_sensitivity[:] = entries[:, LENGTH + 1 :]


def _measure(problem: LoopProblem, frame: int, state: State) -> np.ndarray | None:
    """What the sensor says of the pose (6,) of a state, or None where the frame is lost."""
    pose, rate = state.pose[:6], state.rate[:6]
    if problem.sensor is not None:
        return measurement(problem.sensor, frame, frame * problem.period, pose.copy(), rate.copy())
    if problem.lost is not None and problem.lost[frame]:
        return None
    return pose if problem.noise is None else pose + problem.noise[frame]


def _servo_command(
    servo: VisualServo, frame: int, reference: Reference, measured: np.ndarray, d_pose: np.ndarray | None
) -> Issued:
    command, demand = servo.command(frame, reference, measured)
    tangent = np.zeros((6, 1)) if d_pose is None else servo.command_tangent(measured, demand, d_pose)
    servo.measured_now()
    return command, tangent


def _frame(
    motion: StickSlipMotion,
    state: State,
    issued: list[Issued],
    frame: int,
    problem: LoopProblem,
    schedule: CommandSchedule,
    result: ClosedLoopRun,
) -> State:
    """Integrate from one frame to the next, changing the command whenever another acts."""
    spans = range(*schedule.first_span[frame : frame + 2])
    for span in spans:
        command = _command(issued, int(schedule.command[span]), float(schedule.ramp[span]), problem)
        if span == spans[0]:
            result.torque[frame] = motion.torque_at(state, command)
        if frame + 1 == problem.frames:
            break
        state = motion.segment(state, command, float(schedule.duration[span]), int(schedule.steps[span]))
    return state


def _command(issued: list[Issued], number: int, ramp: float, problem: LoopProblem) -> Command:
    """Command `number` (from frame 0 on) acting on the joints, a share `ramp` of the way from the one before done."""
    first = len(problem.start.commands)
    (value, d_value), (before, d_before) = (issued[max(0, first + number - n)] for n in (0, 1))
    frame_rate = problem.settings.timing.frame_rate_hz
    rate, d_rate = (value - before) * frame_rate, (d_value - d_before) * frame_rate
    if ramp < 1:
        begin, d_begin = before + ramp * (value - before), d_before + ramp * (d_value - d_before)
        return Command(begin, rate, rate, d_begin, d_rate, d_rate)
    return Command(value, np.zeros(6), rate, d_value, np.zeros_like(d_rate), d_rate)


def _start_tangent(problem: LoopProblem) -> tuple[State, np.ndarray]:
    """Derivatives of the first state, and of the servo integral, with the columns of `sensitivity`."""
    columns = LENGTH + 1 + (START_COUNT if problem.start_sensitivities else 0)
    pose, rate, integral, servo_integral = np.zeros((4, 6, columns))
    integral[:, :PARAMETER_COUNT] = problem.start.joint_integral_sensitivity
    if problem.start_sensitivities:
        for block, rows in enumerate((pose, rate, integral, servo_integral)):
            rows[:, LENGTH + 1 + 6 * block :][:, :6] = np.eye(6)
    return State(pose, rate, integral), servo_integral
