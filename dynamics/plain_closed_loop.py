"""The frame loop in plain Python on CasADi's virtual machine: the twin of `run_frames` in `closed_loop.c`."""

from functools import lru_cache
from math import ceil, floor

import casadi as ca
import numpy as np

from dynamics import model
from dynamics.geometry import Rss6Geometry
from dynamics.loop_types import (
    MEASURED_OUT_OF_REACH,
    PARAMETER_COUNT,
    ClosedLoopRun,
    LoopProblem,
    LoopSettings,
    Reference,
    checked_measurement,
    failure,
)
from dynamics.robot import Robot
from dynamics.stick_slip import Command, MotionStopped, State, StickSlipMotion
from dynamics.visual_servo import VisualServo

Issued = tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=16)
def _functions(geometry: Rss6Geometry) -> dict[str, ca.Function]:
    built = model.motion_functions(geometry) + model.kinematic_functions(geometry)
    return {function.name(): function for function in built}


def run(robot: Robot, problem: LoopProblem) -> ClosedLoopRun:
    """Do one run in plain Python; see `closed_loop.simulate`."""
    functions = _functions(robot.geometry)
    reference, settings, period, start = problem.reference, problem.settings, problem.period, problem.start
    motion = StickSlipMotion(functions, problem.parameters, settings.friction, problem.sensitivities)
    servo = VisualServo(functions, settings.servo, period, reference.poses[0], start.servo_integral)
    state = State(reference.poses[0], np.zeros(6), start.joint_integral)
    rest = np.zeros((6, PARAMETER_COUNT))
    if problem.sensitivities:
        motion.tangent = State(rest, rest, start.joint_integral_sensitivity)
    result = _empty(problem.frames, period, problem.sensitivities)
    issued: list[Issued] = [(start.command, rest)]
    for frame in range(problem.frames):
        d_pose = _record_state(result, frame, state, motion)
        measured = _measure(problem, frame, state.pose)
        servo.next_frame()
        result.measured_ok[frame] = measured is not None
        result.measured[frame] = np.nan if measured is None else measured
        if problem.commands is not None:
            issued.append((problem.commands[frame], rest))
        elif measured is None:
            issued.append(issued[-1])
        else:
            issued.append(_servo_command(servo, frame, reference, measured, d_pose))
        result.command[frame] = issued[-1][0]
        if not np.isfinite(issued[-1][0]).all():
            raise failure(MEASURED_OUT_OF_REACH, frame, problem, result.pose, result.measured)
        try:
            state = _frame(motion, state, issued, frame, settings, result)
        except MotionStopped as reason:
            raise failure(str(reason), frame, problem, result.pose, result.measured) from None
    return _with_events(result, motion.events)


def _record_state(result: ClosedLoopRun, frame: int, state: State, motion: StickSlipMotion) -> np.ndarray | None:
    """Write the state at a frame into the result; returns the sensitivity of the pose, if there is one."""
    result.pose[frame], result.pose_rate[frame] = state.pose, state.rate
    if motion.tangent is None or result.pose_sensitivity is None:
        return None
    result.pose_sensitivity[frame] = motion.tangent.pose
    return motion.tangent.pose


def _measure(problem: LoopProblem, frame: int, pose: np.ndarray) -> np.ndarray | None:
    """What the sensor says of a pose (6,), or None where the frame is lost."""
    if problem.sensor is not None:
        return checked_measurement(problem.sensor(frame, frame * problem.period, pose.copy()), frame)
    return None if problem.lost is not None and problem.lost[frame] else pose


def _servo_command(
    servo: VisualServo, frame: int, reference: Reference, measured: np.ndarray, d_pose: np.ndarray | None
) -> Issued:
    command, demand = servo.command(frame, reference, measured)
    tangent = np.zeros((6, PARAMETER_COUNT)) if d_pose is None else servo.command_tangent(measured, demand, d_pose)
    servo.measured_now()
    return command, tangent


def _frame(
    motion: StickSlipMotion,
    state: State,
    issued: list[Issued],
    frame: int,
    settings: LoopSettings,
    result: ClosedLoopRun,
) -> State:
    """Integrate from one frame to the next, changing the command when the newest one arrives."""
    timing = settings.timing
    period = 1.0 / timing.frame_rate_hz
    whole = floor(timing.latency_s / period + 1e-9)
    rest = timing.latency_s - whole * period
    arrival = rest if rest >= 1e-12 else 0.0
    last = frame + 1 == len(result.time)
    if arrival:
        before = _command(issued, frame - whole - 1, settings)
        result.torque[frame] = motion.torque_at(state, before)
        state = motion.segment(state, before, arrival, _steps(settings, arrival * timing.frame_rate_hz))
    now = _command(issued, frame - whole, settings)
    if not arrival:
        result.torque[frame] = motion.torque_at(state, now)
    if last:
        return state
    return motion.segment(state, now, period - arrival, _steps(settings, 1 - arrival * timing.frame_rate_hz))


def _steps(settings: LoopSettings, frames: float) -> int:
    return max(1, ceil(frames * settings.steps_per_frame - 1e-9))


def _command(issued: list[Issued], number: int, settings: LoopSettings) -> Command:
    """Command `number` (from frame 0 on) acting on the joints; before frame 0 the start command."""
    (value, d_value), (before, d_before) = (issued[max(0, number + 1)], issued[max(0, number)])
    frame_rate = settings.timing.frame_rate_hz
    rate, d_rate = (value - before) * frame_rate, (d_value - d_before) * frame_rate
    if settings.timing.hold == "linear":
        return Command(before, rate, rate, d_before, d_rate, d_rate)
    return Command(value, np.zeros(6), rate, d_value, np.zeros_like(d_rate), d_rate)


def _empty(frames: int, period: float, sensitivities: bool) -> ClosedLoopRun:
    pose, rate, torque, command, measured = np.zeros((5, frames, 6))
    tangent = np.zeros((frames, 6, PARAMETER_COUNT)) if sensitivities else None
    ok = np.zeros(frames, dtype=bool)
    return ClosedLoopRun(np.arange(frames) * period, pose, rate, torque, command, measured, ok, tangent, 0)


def _with_events(run: ClosedLoopRun, events: int) -> ClosedLoopRun:
    return ClosedLoopRun(**{**vars(run), "events": events})
