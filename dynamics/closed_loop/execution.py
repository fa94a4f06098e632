"""Doing a run: its problem is put into the memory of the kernels, they do its frames, and the record is handed back.

The same lines run compiled and, as the oracle of that, plain. Sensors and controllers of a user's own are Python: the
kernels then do one frame at a time.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from dynamics.checks import floats
from dynamics.closed_loop.command_schedule import command_schedule
from dynamics.closed_loop.frame_kernels import measure_ideally, run_frames
from dynamics.closed_loop.lane_kernels import run_lanes
from dynamics.closed_loop.memory import Memory, Plan, empty, empty_memory, empty_record
from dynamics.closed_loop.motion_kernels import (
    LEFT_REACH,
    MEASURED_OUT_OF_REACH,
    SINGULAR_MASS,
    TOO_MANY_EVENTS,
    decide_modes,
    evaluate,
    evaluate_terms,
)
from dynamics.closed_loop.problem import EveryFrame, LoopProblem, RateSensor, Sizes
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure, saturated_frames
from dynamics.closed_loop.sensitivity_kernels import slope_tangent, stop_tangent, whole_vectors
from dynamics.closed_loop.stick_slip_kernels import stop_joints
from dynamics.compiled.kernel import address, chosen, plain
from dynamics.compiled.machine_code import MachineFunction
from dynamics.errors import DynamicsError, SimulationError
from dynamics.parameters import LANES

UNSTABLE = " (the loop is unstable)"

FAILURES = {
    LEFT_REACH: f"the robot left the reachable set{UNSTABLE}:",
    SINGULAR_MASS: "the mass matrix is not positive definite: masses or inertias are zero or overflow",
    TOO_MANY_EVENTS: "more stick-slip events than a frame can hold",
    MEASURED_OUT_OF_REACH: "the measured pose is out of reach, so that the servo has no command; there",
}
MACHINE_CODE = (
    *("equation_of_motion", "free_acceleration", "response", "rate_map_derivative"),
    *("stage_derivatives", "stop_derivatives", "slope_derivative"),
)
"""Functions of a robot that kernels call, by their names."""

CALLED = (evaluate_terms, evaluate, decide_modes, stop_joints, slope_tangent, stop_tangent)
"""Kernels that are called by address, by their names."""


def run(problem: LoopProblem, compiled: bool = True) -> ClosedLoopRun:
    """Do one run; see `closed_loop.simulate`."""
    frames = problem.frames
    commands = problem.commands  # a controller's are written frame by frame, and take the place of the servo's, too
    if commands is None:
        commands = np.zeros((0 if problem.controller is None else frames, problem.sizes.joints))
    memory, record, plan, *_held = _set_up(problem, commands, compiled)
    do, arrays = chosen(run_frames, compiled), [part if part.ndim else part.base for part in memory]
    measured = np.full((frames, 6), np.nan)
    for first, last in [(k, k + 1) for k in range(frames)] if problem.asked else [(0, frames)]:
        if problem.asked:
            try:
                _consult(problem, first, memory.now, plan, record, commands, measured)
            except DynamicsError as error:
                raise _stopped(problem, first, record, str(error)) from error
            except Exception as error:
                error.add_note(f"at frame {first} of the closed loop")
                raise
        status, frame = do(*arrays, plan, record, first, last)
        if status:
            raise _failure(problem, status, frame, memory.now, record)
    return _result(problem, record, measured, memory.now)


def run_repeats(problem: LoopProblem, noises: np.ndarray, compiled: bool = True) -> list[ClosedLoopRun | LoopFailure]:
    """A run for each noise (runs, frames, 6); see `closed_loop.simulate_repeats`."""
    found: list[ClosedLoopRun | LoopFailure] = []
    for some in np.split(noises, range(LANES, len(noises), LANES)):
        found += _run_together(problem, some, compiled)
    return found


def _run_together(problem: LoopProblem, noises: np.ndarray, compiled: bool) -> list[ClosedLoopRun | LoopFailure]:
    """Runs that differ in their noise (runs, frames, 6), a lane each."""
    sizes, frames, runs = problem.sizes, problem.frames, len(noises)
    commands = np.zeros((0, sizes.joints)) if problem.commands is None else problem.commands
    every = replace(problem, noise=noises.reshape(-1, 6))
    memory, record, plan, own, *_held = _set_up(every, commands, compiled, runs)
    for name in ("motion_in_lanes", "acceleration_in_lanes"):
        memory.task[name] = own[name].address
    lanes, at = empty("lanes", sizes), np.zeros((runs, 5), memory.evaluations.dtype)
    now = np.repeat(memory.now.reshape(1), runs).view(np.recarray)
    now["first_row"] = frames * np.arange(runs)
    lanes.shared = memory.now.known.inputs[2 * sizes.coordinates :]
    lanes.states = np.tile(memory.now.state[: 2 * sizes.coordinates], (LANES, 1)).T
    chosen(run_lanes, compiled)(memory.task, now, at, memory.tangent, plan, record, lanes)
    found: list[ClosedLoopRun | LoopFailure] = []
    for lane, noise in enumerate(noises):
        rows = slice(lane * frames, (lane + 1) * frames)
        one = type(record)(*[array[rows] for array in record])
        if status := int(now[lane].status):
            found.append(_failure(problem, status, int(now[lane].frame), now[lane], one))
        else:
            found.append(_result(replace(problem, noise=noise), one, np.full((frames, 6), np.nan), now[lane]))
    return found


def _set_up(problem: LoopProblem, commands: np.ndarray, compiled: bool, runs: int = 1) -> tuple[Any, ...]:
    """Memory, record and plan of runs, and the functions of robot and servo, which the caller holds: code that nobody
    holds is freed."""
    memory, own, known = empty_memory(problem.sizes), problem.robot.functions, problem.servo_robot.functions
    _fill(memory, problem, own, known["servo_jacobian"], _addresses(problem.sizes, compiled))
    return memory, empty_record(problem, runs), _plan(problem, commands), own, known


def _result(problem: LoopProblem, record: Any, measured: np.ndarray, now: Any) -> ClosedLoopRun:
    """What a run that came to its end has recorded."""
    found: dict[str, Any] = {name: array if array.size else None for name, array in record._asdict().items()}
    found |= _poses(problem, found, measured)
    time, events = np.arange(problem.frames) * problem.period, int(now.events)
    return ClosedLoopRun(time=time, **found, events=events, start=problem.start)


def _poses(problem: LoopProblem, found: dict[str, Any], measured: np.ndarray) -> dict[str, Any]:
    """What the kernels say of coordinates, as poses."""
    chart = problem.robot.geometry.chart
    poses = {"pose": chart.pose(found["pose"]), "pose_rate": chart.lifted(found["pose_rate"]), "measured": measured}
    if problem.sensor is None:
        poses["measured"] = chart.pose(found["measured"])
        poses["measured"][~found["measured_ok"]] = np.nan
        if problem.noise is not None and problem.sizes.coordinates < 6:
            poses["measured"] += chart.forbidden(chart.pose(np.zeros(problem.sizes.coordinates)) + problem.noise)
    for name in ("pose_sensitivity", "start_sensitivity"):
        if found[name] is not None:
            poses[name] = chart.lifted(found[name], axis=1)
    return poses


def _consult(
    problem: LoopProblem,
    frame: int,
    now: Any,
    plan: Plan,
    record: Any,
    commands: np.ndarray,
    measured: np.ndarray,
) -> None:
    """Ask a user's own sensor what it measures at a frame, and the controller for a command."""
    sensor, size, time = problem.sensor, problem.sizes.coordinates, frame * problem.period
    chart = problem.robot.geometry.chart
    if sensor is None:
        plain(measure_ideally)(now, plan, record, frame)
        measured[frame] = chart.pose(record.measured[frame])
    else:
        state = now["state"]  # an attribute of a record takes five times as long
        pose, rate = chart.pose(state[:size]), chart.lifted(state[size : 2 * size]).copy()
        given = sensor.measure(frame, time, pose, rate) if isinstance(sensor, RateSensor) else sensor(frame, time, pose)
        record.measured_ok[frame] = given is not None
        what = "what the pose sensor returned"
        measured[frame] = np.nan if given is None else floats(what, given, (6,), error=SimulationError)
        record.measured[frame] = chart.coordinates(measured[frame])
    controller = problem.controller
    if controller is None:
        return
    commands[frame] = commands[frame - 1] if frame else problem.start.commands[-1]
    seen = measured[frame].copy() if record.measured_ok[frame] else None
    if isinstance(controller, EveryFrame):
        command = controller.command(frame, time, seen)
    elif seen is not None:
        command = controller(frame, time, seen, problem.reference.poses[frame], problem.reference.rates[frame])
    else:
        return
    what = "what the controller returned"
    commands[frame] = floats(what, command, (problem.sizes.joints,), error=SimulationError)


def _failure(problem: LoopProblem, status: int, frame: int, now: Any, record: Any) -> LoopFailure:
    """The error of a run that ended early, with the leg to blame for a pose out of reach."""
    why = FAILURES[status]
    if status in (LEFT_REACH, MEASURED_OUT_OF_REACH):
        stopped = now.known.inputs[: problem.sizes.coordinates]
        at = problem.robot.pose(stopped if status == LEFT_REACH else record.measured[frame])
        margin = problem.robot.reach_margin(at)
        leg = int(np.argmin(margin))
        why += f" leg {leg + 1} has the least reach margin, {margin[leg]:.3g}, must be > 0"
    return _stopped(problem, frame, record, why)


def _stopped(problem: LoopProblem, frame: int, record: Any, why: str) -> LoopFailure:
    """The same of any reason, with what the actuators had to give before."""
    limit, unit = problem.settings.drives.torque_limit, problem.robot.layout.unit("joint1.coulomb")
    saturated, when = saturated_frames(record.torque[:frame], limit), f"t = {frame * problem.period:.3f} s"
    if saturated:  # of weak actuators, too, a robot leaves the set
        why = why.replace(UNSTABLE, "")
        when += f", saturated in {saturated} of {frame} frames, limit {limit:g} {unit}"
    return LoopFailure(f"closed loop stopped at frame {frame} ({when}): {why}", frame, saturated)


def _plan(problem: LoopProblem, commands: np.ndarray) -> Plan:
    start, chart, sizes = problem.start, problem.robot.geometry.chart, problem.sizes
    slope, still = start.joint_integral_sensitivity, np.zeros((sizes.joints, sizes.parameters))
    by_command = still if start.command_sensitivity is None else start.command_sensitivity
    given = {
        "reference": chart.coordinates(problem.reference.poses),
        "reference_rate": chart.coordinates(problem.reference.rates),
        "commands": commands,
        "feedforward": np.zeros((0, 0)) if problem.feedforward is None else problem.feedforward,
        "lost": np.zeros(0, bool) if problem.lost is None else np.ascontiguousarray(problem.lost),
        "noise": np.zeros((0, 0)) if problem.noise is None else chart.coordinates(problem.noise),
        "start_commands": start.commands,
        "start_integral_sensitivity": (still if slope is None else slope)[:, problem.columns],
        "start_servo_sensitivity": _servo_sensitivity(problem, by_command)[:, problem.columns],
        "start_command_sensitivity": by_command[:, problem.columns],
    }
    views = {name: np.ascontiguousarray(array).view() for name, array in given.items()}
    for view in views.values():  # kernels are compiled for each kind of array that they are given, so all are of one
        view.flags.writeable = False
    return Plan(**views, spans=command_schedule(problem))


def _servo_sensitivity(problem: LoopProblem, by_command: np.ndarray) -> np.ndarray:
    """How the servo's integral (m, p), which makes the command at rest, follows the parameters as that does (n, p)."""
    ki, size = problem.settings.servo.ki, problem.sizes.coordinates
    if not ki or not by_command.any() or problem.feedforward is not None:
        return np.zeros((size, by_command.shape[1]))
    return np.linalg.solve(problem.servo_robot.coordinate_jacobian(problem.start.pose), by_command) / ki


def _fill(
    memory: Memory,
    problem: LoopProblem,
    own: dict[str, MachineFunction],
    servo_jacobian: MachineFunction,
    addresses: dict[str, int],
) -> None:
    """Machine code, laws, parameters and gains, and the state at the first frame."""
    task, now, start, sizes = memory.task, memory.now, problem.start, problem.sizes
    settings = problem.settings
    for name in MACHINE_CODE:
        task[name] = own[name].address
    for name, found in addresses.items():
        task[name] = found
    task.servo_jacobian = servo_jacobian.address
    rigid, task.coulomb, task.viscous, gains = problem.robot.layout.split(problem.parameters)
    law = settings.drives.joint_law(gains)
    for name, value in law._asdict().items():
        task[name] = value
    task.kp, task.kd, task.ki = settings.servo.kp, settings.servo.kd, settings.servo.ki
    task.friction = settings.friction.record
    task.period = problem.period
    task.sensitivities = problem.sensitivities
    task.measured = problem.asked
    task.torques, task.torque_limit = settings.drives.torques, settings.drives.torque_limit or 0.0
    if settings.elasticity is not None:
        rigid = settings.elasticity.beyond_the_springs(problem.robot.layout, rigid)
        task.stiffness, task.damping = settings.elasticity.stiffness, settings.elasticity.damping
        task.motor_inertia = settings.elasticity.motor_inertia
    task.rigid = rigid
    columns, shown = problem.columns, len(problem.columns) - 2 * sizes.joints - len(gains)
    task.shown, task.pivots[:shown] = shown, columns[:shown]
    rest = np.zeros(sizes.joints)
    filtered = rest[: sizes.filters] if start.filtered_rate is None else start.filtered_rate[: sizes.filters]
    motor = [rest if part is None else part for part in (start.motor_angle, start.motor_rate)]
    chart = problem.robot.geometry.chart
    now.state = np.concatenate(
        [chart.coordinates(start.pose), chart.coordinates(start.pose_rate), start.joint_integral, filtered, *motor]
    )
    now.servo_integral, now.last_measured = start.servo_integral, chart.coordinates(start.last_measured)
    now.last_command = start.commands[-1] if problem.feedforward is None else 0.0
    task.servo_knows = problem.servo_robot.geometry == problem.robot.geometry
    for inputs, function, fixed in (
        (now.known.inputs, own["equation_of_motion"], rigid),
        (now.served.inputs, servo_jacobian, rigid[:0]),
        (now.stages.inputs, own["stage_derivatives"], rigid),
        (now.stopping.inputs, own["stop_derivatives"], rigid),
        (now.pose_and_rate, own["rate_map_derivative"], rigid[:0]),
    ):
        last = np.concatenate([fixed, function.constants])
        end = sum(function.inputs)
        inputs[end - len(last) : end].T[...] = last
    elastic = settings.elasticity is not None
    now.unknowns = len(now.state) - (0 if elastic else 2 * sizes.joints)  # motors come last
    now.parameters, now.start_moves = len(columns), problem.start_sensitivities
    now.step_column = len(columns) + (sizes.start if problem.start_sensitivities else 0)
    now.width = plain(whole_vectors)(int(now.step_column))


@lru_cache(maxsize=16)
def _addresses(sizes: Sizes, compiled: bool) -> dict[str, int]:
    """Of the kernels that kernels call by address."""
    memory = empty_memory(sizes)
    arguments = memory.task, memory.now, memory.evaluations[0], memory.tangent, 0
    lines = {kernel: getattr(kernel, "py_func", kernel) for kernel in CALLED}
    return {line.__name__: address(kernel if compiled else line, *arguments) for kernel, line in lines.items()}
