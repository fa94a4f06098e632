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
    LoopSettings,
    PoseSensor,
    Reference,
    StartState,
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


def run(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    start: StartState,
    sensor: PoseSensor | None,
    sensitivities: bool,
    commands: np.ndarray | None,
    lost: np.ndarray | None,
) -> ClosedLoopRun:
    """See `closed_loop.simulate`; arguments are already checked."""
    period, frames = 1.0 / settings.timing.frame_rate_hz, len(reference.poses)
    functions = _functions(robot.geometry)
    motion = StickSlipMotion(functions, parameters, settings.friction, sensitivities)
    servo = VisualServo(functions, settings.servo, period, reference.poses[0], start.servo_integral)
    state = State(reference.poses[0], np.zeros(6), start.joint_integral)
    if sensitivities:
        rest = np.zeros((6, PARAMETER_COUNT))
        motion.tangent = State(rest, rest, start.joint_integral_sensitivity)
    result = _empty(frames, period, sensitivities)
    issued: list[Issued] = [(start.command, np.zeros((6, PARAMETER_COUNT)))]
    for frame in range(frames):
        result.pose[frame], result.pose_rate[frame] = state.pose, state.rate
        d_pose = motion.tangent.pose if motion.tangent is not None else None
        if result.pose_sensitivity is not None:
            result.pose_sensitivity[frame] = d_pose
        measured: np.ndarray | None = state.pose
        if sensor is not None:
            measured = checked_measurement(sensor(frame, frame * period, state.pose.copy()), frame)
        elif lost is not None and lost[frame]:
            measured = None
        servo.next_frame()
        result.measured_ok[frame] = measured is not None
        result.measured[frame] = np.nan if measured is None else measured
        if commands is not None:
            issued.append((commands[frame], np.zeros((6, PARAMETER_COUNT))))
        elif measured is None:
            issued.append(issued[-1])
        else:
            issued.append(_servo_command(servo, frame, reference, measured, d_pose))
        result.command[frame] = issued[-1][0]
        if not np.isfinite(issued[-1][0]).all():
            raise failure(MEASURED_OUT_OF_REACH, frame, period)
        try:
            state = _frame(motion, state, issued, frame, settings, result)
        except MotionStopped as reason:
            raise failure(str(reason), frame, period) from None
    return _with_events(result, motion.events)


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
