"""Execution of a run: the kernels process its frames in the memory that is set up here.

The kernels run compiled. Tests run them as plain Python, too, to compare both. If a sensor or a
controller is a Python function, kernels process one frame at a time. They return a status, which
the error of a run that ends early puts into words.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from dynamics.checks import floats
from dynamics.closed_loop.command_schedule import command_schedule
from dynamics.closed_loop.frame_kernels import run_frames
from dynamics.closed_loop.lane_kernels import run_lanes
from dynamics.closed_loop.loop_settings import (
    IDEAL,
    EveryFrame,
    IdealSensor,
    RateSensor,
    ideal_poses,
)
from dynamics.closed_loop.motion_kernels import (
    LEFT_REACH,
    MEASURED_OUT_OF_REACH,
    SINGULAR_MASS,
    TOO_MANY_EVENTS,
    decide_modes,
    evaluate,
    evaluate_terms,
)
from dynamics.closed_loop.problem import LoopProblem, Sizes
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure, saturated_frames
from dynamics.closed_loop.run_memory import Memory, Plan, empty, empty_memory, empty_record
from dynamics.closed_loop.sensitivity_kernels import slope_tangent, stop_tangent, whole_vectors
from dynamics.closed_loop.stick_slip_kernels import stop_joints
from dynamics.closed_loop.visual_servo_kernels import measure_ideally
from dynamics.compiled.kernel import address, chosen, plain
from dynamics.compiled.machine_code import Functions, MachineFunction
from dynamics.errors import DynamicsError, SimulationError
from dynamics.parameters import LANES

# Names of the robot's functions that kernels call.
MACHINE_CODE = (
    *("equation_of_motion", "free_acceleration", "response", "rate_map_derivative"),
    *("stage_derivatives", "stop_derivatives", "slope_derivative"),
)
# Kernels that other kernels call by address.
CALLED = (evaluate_terms, evaluate, decide_modes, stop_joints, slope_tangent, stop_tangent)
UNSTABLE = " (the loop is unstable)"
# Reasons why a run ended early, by status. `failure` adds the leg to those about reach.
FAILURES = {
    LEFT_REACH: f"the robot left the reachable set{UNSTABLE}:",
    SINGULAR_MASS: "the mass matrix is not positive definite: masses or inertias are zero or "
    "overflow",
    TOO_MANY_EVENTS: "too many stick-slip events while one command acts",
    MEASURED_OUT_OF_REACH: "the measured pose is out of reach, and the servo has no command; there",
}


def run(problem: LoopProblem, compiled: bool = True) -> ClosedLoopRun:
    """Do one run. Raises LoopFailure, or the exception of a user's sensor or controller."""
    frames = problem.frames
    # a controller's commands are written here frame by frame, and read like given commands
    commands = problem.commands
    if commands is None:
        commands = np.zeros((0 if problem.controller is None else frames, problem.sizes.joints))
    memory, record, plan, *_kept = _set_up(problem, commands, compiled)
    run_kernel = chosen(run_frames, compiled)
    # arrays of one record each, because passing a record takes 8 us in each call
    arrays = [part if part.ndim else part.base for part in memory]
    measured = np.full((frames, 6), np.nan)
    for first, last in [(k, k + 1) for k in range(frames)] if problem.asked else [(0, frames)]:
        if problem.asked:
            try:
                _consult(problem, first, memory.now, plan, record, commands, measured)
            except DynamicsError as error:
                raise stopped(problem, first, record, str(error)) from error
            except Exception as error:
                # the exception of a user's function is raised unchanged, with the frame as a note
                error.add_note(f"at frame {first} of the closed loop")
                raise
        status, frame = run_kernel(*arrays, plan, record, first, last)
        if status:
            raise failure(problem, status, frame, memory.now, record)
    return _result(problem, record, measured, memory.now)


def run_repeats(
    problem: LoopProblem, noises: np.ndarray, compiled: bool = True
) -> list[ClosedLoopRun | LoopFailure]:
    """Do one run for each of the noises (runs, frames, 6) of the ideal sensor, LANES at a time."""
    results: list[ClosedLoopRun | LoopFailure] = []
    for group in np.split(noises, range(LANES, len(noises), LANES)):
        results += _run_together(problem, group, compiled)
    return results


def _run_together(
    problem: LoopProblem, noises: np.ndarray, compiled: bool
) -> list[ClosedLoopRun | LoopFailure]:
    """Do at most LANES runs that differ in their noise (runs, frames, 6), as in `lane_kernels`."""
    sizes = problem.sizes
    frames = problem.frames
    runs = len(noises)
    commands = np.zeros((0, sizes.joints)) if problem.commands is None else problem.commands
    # the noise of all runs is in one array, and each run reads its own rows
    stacked = _with_noise(problem, noises.reshape(-1, 6))
    memory, record, plan, functions, *_kept = _set_up(stacked, commands, compiled, runs)
    for name in ("motion_in_lanes", "acceleration_in_lanes"):
        memory.task[name] = functions[name].address
    lanes = empty("lanes", sizes)
    evaluations = np.zeros((runs, 5), memory.evaluations.dtype)
    now = np.repeat(memory.now.reshape(1), runs).view(np.recarray)
    now["first_row"] = frames * np.arange(runs)
    lanes.shared = memory.now.known.inputs[2 * sizes.coordinates :]
    # lanes without a run use the first state, so that their numbers are valid
    lanes.states = np.tile(memory.now.state[: 2 * sizes.coordinates], (LANES, 1)).T
    chosen(run_lanes, compiled)(memory.task, now, evaluations, memory.tangent, plan, record, lanes)
    results: list[ClosedLoopRun | LoopFailure] = []
    unmeasured = np.full((frames, 6), np.nan)
    for lane, noise in enumerate(noises):
        rows = slice(lane * frames, (lane + 1) * frames)
        run_record = type(record)(*[array[rows] for array in record])
        if status := int(now[lane].status):
            results.append(failure(problem, status, int(now[lane].frame), now[lane], run_record))
        else:
            results.append(_result(_with_noise(problem, noise), run_record, unmeasured, now[lane]))
    return results


def _set_up(
    problem: LoopProblem, commands: np.ndarray, compiled: bool, runs: int = 1
) -> tuple[Any, ...]:
    """Memory, record and plan of runs, and the functions of `robot` and of `servo_robot`.

    The caller must keep a reference to the functions, because their machine code is freed with
    them.
    """
    memory = empty_memory(problem.sizes)
    own = problem.robot.functions
    known = problem.servo_robot.functions
    _fill(memory, problem, own, known["servo_jacobian"], _addresses(problem.sizes, compiled))
    return memory, empty_record(problem, runs), _plan(problem, commands), own, known


def _result(problem: LoopProblem, record: Any, measured: np.ndarray, now: Any) -> ClosedLoopRun:
    """Record of a run that was completed."""
    fields: dict[str, Any] = {
        name: array if array.size else None for name, array in record._asdict().items()
    }
    fields |= _poses(problem, fields, measured)
    time = problem.frame_times.copy()
    return ClosedLoopRun(time=time, **fields, events=int(now.events), start=problem.start)


def _poses(problem: LoopProblem, recorded: dict[str, Any], measured: np.ndarray) -> dict[str, Any]:
    """Poses, pose rates and sensitivities, from the coordinates that the kernels have recorded."""
    chart = problem.robot.geometry.chart
    poses = {
        "pose": chart.pose(recorded["pose"]),
        "pose_rate": chart.lifted(recorded["pose_rate"]),
        "measured": measured,
    }
    if problem.ideal is not None:
        poses["measured"] = ideal_poses(problem.ideal, chart, recorded["measured"])
        poses["measured"][~recorded["measured_ok"]] = np.nan
    for name in ("pose_sensitivity", "start_sensitivity", "command_sensitivity"):
        if recorded[name] is not None:
            poses[name] = chart.lifted(recorded[name], axis=1)
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
    """Measure the pose of a frame, and call the controller, if there is one, for the command."""
    sensor = problem.sensor
    size = problem.sizes.coordinates
    time = float(problem.frame_times[frame])
    chart = problem.robot.geometry.chart
    if isinstance(sensor, IdealSensor):
        plain(measure_ideally)(now, plan, record, frame)
        measured[frame] = ideal_poses(sensor, chart, record.measured[frame], frame)
    else:
        # access to an attribute of a record takes five times as long as access to an item
        state = now["state"]
        pose = chart.pose(state[:size])
        rate = chart.lifted(state[size : 2 * size]).copy()
        value = (
            sensor.measure(frame, time, pose, rate)
            if isinstance(sensor, RateSensor)
            else sensor(frame, time, pose)
        )
        record.measured_ok[frame] = value is not None
        what = "value returned by the pose sensor"
        measured[frame] = (
            np.nan if value is None else floats(what, value, (6,), error=SimulationError)
        )
        record.measured[frame] = chart.coordinates(measured[frame])
    controller = problem.controller
    if controller is None:
        return
    commands[frame] = commands[frame - 1] if frame else problem.start.commands[-1]
    seen = measured[frame].copy() if record.measured_ok[frame] else None
    if isinstance(controller, EveryFrame):
        command = controller.command(frame, time, seen)
    elif seen is not None:
        command = controller(
            frame, time, seen, problem.reference.poses[frame], problem.reference.rates[frame]
        )
    else:
        return
    what = "value returned by the controller"
    commands[frame] = floats(what, command, (problem.sizes.joints,), error=SimulationError)


def _with_noise(problem: LoopProblem, noise: np.ndarray) -> LoopProblem:
    """Problem with another noise (rows, 6) of its ideal sensor."""
    return replace(problem, sensor=IdealSensor((problem.ideal or IDEAL).lost, noise))


def _plan(problem: LoopProblem, commands: np.ndarray) -> Plan:
    """Arrays that a run reads."""
    ideal = problem.ideal or IDEAL
    start = problem.start
    chart = problem.robot.geometry.chart
    sizes = problem.sizes
    integral = start.joint_integral_sensitivity
    zeros = np.zeros((sizes.joints, sizes.parameters))
    by_command = zeros if start.command_sensitivity is None else start.command_sensitivity
    arrays = {
        "reference": chart.coordinates(problem.reference.poses),
        "reference_rate": chart.coordinates(problem.reference.rates),
        "commands": commands,
        "directions": problem.directions,
        "start_directions": problem.start_directions,
        "feedforward": np.zeros((0, 0)) if problem.feedforward is None else problem.feedforward,
        "lost": np.zeros(0, bool) if ideal.lost is None else np.ascontiguousarray(ideal.lost),
        "noise": np.zeros((0, 0)) if ideal.noise is None else chart.coordinates(ideal.noise),
        "start_commands": start.commands,
        "start_integral_sensitivity": (zeros if integral is None else integral)[:, problem.columns],
        "start_servo_sensitivity": _servo_sensitivity(problem, by_command)[:, problem.columns],
        "start_command_sensitivity": by_command[:, problem.columns],
    }
    views = {name: np.ascontiguousarray(array).view() for name, array in arrays.items()}
    # Numba compiles kernels for each array type, so all arrays have the same type: read-only
    for view in views.values():
        view.flags.writeable = False
    return Plan(**views, spans=command_schedule(problem))


def _servo_sensitivity(problem: LoopProblem, by_command: np.ndarray) -> np.ndarray:
    """Derivatives (m, p) of the servo integral at rest.

    They follow from those of the command (n, p), because the integral determines the command.
    """
    ki = problem.settings.servo.ki
    size = problem.sizes.coordinates
    if not ki or not by_command.any() or problem.feedforward is not None:
        return np.zeros((size, by_command.shape[1]))
    return (
        np.linalg.solve(problem.servo_robot.coordinate_jacobian(problem.start.pose), by_command)
        / ki
    )


def _fill(
    memory: Memory,
    problem: LoopProblem,
    functions: Functions,
    servo_jacobian: MachineFunction,
    addresses: dict[str, int],
) -> None:
    """Write functions, laws, parameters, gains and the first state into the memory of a run."""
    task = memory.task
    now = memory.now
    start = problem.start
    sizes = problem.sizes
    settings = problem.settings
    for name in MACHINE_CODE:
        task[name] = functions[name].address
    for name, kernel_address in addresses.items():
        task[name] = kernel_address
    task.servo_jacobian = servo_jacobian.address
    rigid, task.coulomb, task.viscous, gains = problem.robot.layout.split(problem.parameters)
    law = settings.drives.joint_law(gains)
    task.gain_step = gains.shape[1] if problem.robot.layout.own_gains else 0
    for name, value in (law._asdict() | settings.drives.interface(sizes.joints)).items():
        task[name] = value
    task.kp = settings.servo.kp
    task.kd = settings.servo.kd
    task.ki = settings.servo.ki
    task.friction = settings.friction.record
    task.period = problem.period
    task.sensitivities = problem.sensitivities
    task.measured = problem.asked
    task.torques = settings.drives.torques
    task.torque_limit = settings.drives.torque_limit or 0.0
    if settings.elasticity is not None:
        rigid = settings.elasticity.beyond_the_springs(problem.robot.layout, rigid)
        task.stiffness = settings.elasticity.stiffness
        task.damping = settings.elasticity.damping
        task.motor_inertia = settings.elasticity.motor_inertia
    # If the joints are elastic, the inertia of the motors is not part of these parameters.
    task.rigid = rigid
    # indices of the parameters of rigid bodies that have a column of derivatives
    columns = problem.columns
    rigid_columns = len(problem.columns) - 2 * sizes.joints - sizes.gains
    task.shown = rigid_columns
    task.pivots[:rigid_columns] = columns[:rigid_columns]
    rest = np.zeros(sizes.joints)
    filtered = (
        rest[: sizes.filters]
        if start.filtered_rate is None
        else start.filtered_rate[: sizes.filters]
    )
    motor = [rest if part is None else part for part in (start.motor_angle, start.motor_rate)]
    chart = problem.robot.geometry.chart
    now.state = np.concatenate(
        [
            chart.coordinates(start.pose),
            chart.coordinates(start.pose_rate),
            start.joint_integral,
            filtered,
            *motor,
        ]
    )
    now.servo_integral = start.servo_integral
    now.last_measured = chart.coordinates(start.last_measured)
    # with a feedforward, the servo's part of the command is zero at the start
    now.last_command = start.commands[-1] if problem.feedforward is None else 0.0
    # with the same geometry, the servo can use the Jacobian computed for the motion
    task.servo_knows = problem.servo_robot.geometry == problem.robot.geometry
    # The last inputs of a function are constants: parameters and geometric numbers. If its inputs
    # have a column for each Runge-Kutta stage, all columns have the same constants.
    for inputs, function, constants in (
        (now.known.inputs, functions["equation_of_motion"], rigid),
        (now.served.inputs, servo_jacobian, rigid[:0]),
        (now.stages.inputs, functions["stage_derivatives"], rigid),
        (now.stopping.inputs, functions["stop_derivatives"], rigid),
        (now.pose_and_rate, functions["rate_map_derivative"], rigid[:0]),
    ):
        trailing = np.concatenate([constants, function.constants])
        end = sum(function.inputs)
        inputs[end - len(trailing) : end].T[...] = trailing
    # rigid joints do not use the motors, which come last in the state
    now.unknowns = len(now.state) - (0 if settings.elasticity else 2 * sizes.joints)
    now.parameters = len(columns)
    now.start_moves = problem.start_sensitivities
    now.step_column = len(columns) + problem.further_columns
    # kernels work on groups of LANES columns, so that the last columns can be unused
    now.width = plain(whole_vectors)(int(now.step_column))


@lru_cache(maxsize=16)
def _addresses(sizes: Sizes, compiled: bool) -> dict[str, int]:
    """Addresses, by name, of the kernels that other kernels call by address."""
    memory = empty_memory(sizes)
    arguments = memory.task, memory.now, memory.evaluations[0], memory.tangent, 0
    functions = {kernel: getattr(kernel, "py_func", kernel) for kernel in CALLED}
    return {
        function.__name__: address(kernel if compiled else function, *arguments)
        for kernel, function in functions.items()
    }


def failure(problem: LoopProblem, status: int, frame: int, now: Any, record: Any) -> LoopFailure:
    """Error of a run that ended with a status. It names the leg if a leg was out of reach."""
    why = FAILURES[status]
    if status in (LEFT_REACH, MEASURED_OUT_OF_REACH):
        evaluated = now.known.inputs[: problem.sizes.coordinates]
        pose = problem.robot.pose(evaluated if status == LEFT_REACH else record.measured[frame])
        margin = problem.robot.reach_margin(pose)
        leg = int(np.argmin(margin))
        why += f" leg {leg + 1} has the least reach margin, {margin[leg]:.3g}, must be > 0"
    return stopped(problem, frame, record, why)


def stopped(problem: LoopProblem, frame: int, record: Any, why: str) -> LoopFailure:
    """Error of a run that ended early. The message counts the frames with saturated actuators."""
    limit = problem.settings.drives.torque_limit
    unit = problem.robot.layout.unit("joint1.coulomb")
    run = "closed loop" if problem.commands is None else "run under commands"
    saturated = saturated_frames(record.torque[:frame], limit)
    when = f"t = {problem.frame_times[frame]:.3f} s"
    # saturated actuators or given commands can take a robot out of reach in a stable loop, too
    if saturated or problem.commands is not None:
        why = why.replace(UNSTABLE, "")
    if saturated:
        when += f", saturated in {saturated} of {frame} frames, limit {limit:g} {unit}"
    return LoopFailure(f"{run} stopped at frame {frame} ({when}): {why}", frame, saturated)
