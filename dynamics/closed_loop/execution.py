"""Doing a run: its problem is put into the memory of the kernels, they do its frames, and the record is handed back.

The same lines run compiled and, as the oracle of that, plain. Sensors and controllers of a user's own are Python: the
kernels then do one frame at a time.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from dynamics.closed_loop import motion_kernels
from dynamics.closed_loop.command_schedule import command_schedule
from dynamics.closed_loop.frame_kernels import run_frames
from dynamics.closed_loop.memory import Plan, Record, Sizes, empty_memory
from dynamics.closed_loop.motion_kernels import decide_modes, evaluate, evaluate_terms
from dynamics.closed_loop.problem import (
    LEFT_REACH,
    MEASURED_OUT_OF_REACH,
    SINGULAR_MASS,
    LoopProblem,
    measurement,
    own_command,
)
from dynamics.closed_loop.run import ClosedLoopRun, empty_run, failure
from dynamics.closed_loop.sensitivity_kernels import slope_tangent, stop_tangent
from dynamics.closed_loop.stick_slip_kernels import stop_joints
from dynamics.compiled.kernel import address, plain
from dynamics.parameters import split_parameters

FAILURES = {
    motion_kernels.LEFT_REACH: LEFT_REACH,
    motion_kernels.SINGULAR_MASS: SINGULAR_MASS,
    motion_kernels.TOO_MANY_EVENTS: "more stick-slip events than a frame can hold",
    motion_kernels.MEASURED_OUT_OF_REACH: MEASURED_OUT_OF_REACH,
}
CALLED = {
    "evaluate_terms": evaluate_terms,
    "evaluate": evaluate,
    "decide_modes": decide_modes,
    "stop_joints": stop_joints,
    "slope_tangent": slope_tangent,
    "stop_tangent": stop_tangent,
}
"""Kernels that are called by address, by the names of these."""


def run(problem: LoopProblem, compiled: bool = True) -> ClosedLoopRun:
    """Do one run; see `closed_loop.simulate`."""
    result, commands = empty_run(problem), _commands(problem)
    sizes = _sizes(problem)
    memory, plan, record = empty_memory(sizes), _plan(problem, commands), _record(result, sizes)
    _fill_task(memory.task, problem, sizes)
    _fill_now(memory.now, problem, sizes, memory.task.rigid)
    frames = run_frames if compiled else np.errstate(all="ignore")(plain(run_frames))
    asked = problem.sensor is not None or problem.controller is not None
    for first, last in [(k, k + 1) for k in range(problem.frames)] if asked else [(0, problem.frames)]:
        if asked:
            _consult(problem, first, memory.now.state, result, commands)
        status, frame = frames(*memory, plan, record, first, last)
        if status:
            raise failure(FAILURES[status], frame, problem, memory.now.known.inputs[:6].copy(), result.measured)
    return replace(result, events=int(memory.now.events))


def _consult(problem: LoopProblem, frame: int, state: np.ndarray, result: ClosedLoopRun, commands: np.ndarray) -> None:
    """Ask a user's own sensor what it measures at a frame, and the controller for a command."""
    pose, rate = state[:6].copy(), state[6:12].copy()
    measured: np.ndarray | None = pose
    if problem.sensor is not None:
        measured = measurement(problem.sensor, frame, frame * problem.period, pose, rate)
    elif problem.lost is not None and problem.lost[frame]:
        measured = None
    elif problem.noise is not None:
        measured = pose + problem.noise[frame]
    result.measured_ok[frame] = measured is not None
    result.measured[frame] = np.nan if measured is None else measured
    if problem.controller is None:
        return
    commands[frame] = commands[frame - 1] if frame else problem.start.commands[-1]
    if measured is not None:
        commands[frame] = own_command(problem.controller, problem, frame, measured)


def _sizes(problem: LoopProblem) -> Sizes:
    """Those of the robot's equation of motion."""
    motion = problem.robot.functions["equation_of_motion"]
    return Sizes(joints=motion.outputs[2][0], coordinates=motion.inputs[0], rigid=motion.inputs[2])


def _commands(problem: LoopProblem) -> np.ndarray:
    """Commands (frames, n) that take the place of the servo's, to be written by a controller; none: (0, n)."""
    if problem.commands is not None:
        return problem.commands
    return np.zeros((problem.frames if problem.controller else 0, problem.start.commands.shape[1]))


def _plan(problem: LoopProblem, commands: np.ndarray) -> Plan:
    schedule, start = command_schedule(problem), problem.start
    plan = Plan(
        reference=problem.reference.poses,
        reference_rate=problem.reference.rates,
        commands=commands,
        lost=np.zeros(0, bool) if problem.lost is None else problem.lost,
        noise=np.zeros((0, 0)) if problem.noise is None else problem.noise,
        first_span=schedule.first_span,
        span_command=schedule.command,
        span_ramp=schedule.ramp,
        span_duration=schedule.duration,
        span_steps=schedule.steps,
        start_commands=start.commands,
        start_integral_sensitivity=start.joint_integral_sensitivity,
    )
    return Plan(*map(_read_only, plan))


def _read_only(array: np.ndarray) -> np.ndarray:
    """A view: kernels are compiled for each kind of array that they are given, so all are of one."""
    view = array.view()
    view.flags.writeable = False
    return view


def _record(result: ClosedLoopRun, sizes: Sizes) -> Record:
    """The arrays of a run; those that it is not asked for have no rows or columns."""
    values = {name: getattr(result, name) for name in Record._fields}
    absent = {name: np.zeros((0, 0)) for name in values} | {
        "pose_sensitivity": np.zeros((0, 0, 0)),
        "start_sensitivity": np.zeros((len(result.time), sizes.coordinates, 0)),
        "end_start_sensitivity": np.zeros((sizes.start, 0)),
    }
    return Record(**{name: absent[name] if value is None else value for name, value in values.items()})


def _fill_task(task: Any, problem: LoopProblem, sizes: Sizes) -> None:
    """Machine code, laws, parameters and gains."""
    settings, known = problem.settings, problem.servo_robot.functions
    for name in ("equation_of_motion", "motion_derivatives", "rate_map_derivative"):
        task[name] = problem.robot.functions[name].address
    for name, found in _addresses(sizes).items():
        task[name] = found
    task.servo_motion = known["equation_of_motion"].address
    rigid, task.coulomb, task.viscous, (task.lp, task.li, task.ld) = split_parameters(problem.parameters)
    task.kp, task.kd, task.ki = settings.servo.kp, settings.servo.kd, settings.servo.ki
    task.friction = settings.friction.record
    task.period = problem.period
    task.sensitivities = problem.sensitivities
    task.measured = problem.sensor is not None or problem.controller is not None
    if settings.elasticity is not None:
        rigid = settings.elasticity.beyond_the_springs(rigid)
        task.stiffness, task.damping = settings.elasticity.stiffness, settings.elasticity.damping
        task.motor_inertia = settings.elasticity.motor_inertia
    task.rigid = rigid


@lru_cache(maxsize=16)
def _addresses(sizes: Sizes) -> dict[str, int]:
    """Of the kernels that kernels call by address."""
    memory = empty_memory(sizes)
    arguments = memory.task, memory.now, memory.evaluations[0], memory.tangent, 0
    return {name: address(kernel, *arguments) for name, kernel in CALLED.items()}


def _fill_now(now: Any, problem: LoopProblem, sizes: Sizes, rigid: np.ndarray) -> None:
    """The state at the first frame."""
    start, rest = problem.start, np.zeros(sizes.joints)
    motor = [rest if part is None else part for part in (start.motor_angle, start.motor_rate)]
    now.state = np.concatenate([start.pose, start.pose_rate, start.joint_integral, *motor])
    now.servo_integral, now.last_measured = start.servo_integral, start.last_measured
    now.last_command = start.commands[-1]
    for room in (now.known, now.served, now.derivatives):
        room.inputs[-sizes.rigid :] = rigid
    now.step_column, now.start_moves = sizes.parameters, problem.start_sensitivities
    now.width = sizes.parameters + 1 + (sizes.start if problem.start_sensitivities else 0)
