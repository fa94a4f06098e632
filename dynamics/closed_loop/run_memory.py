"""Memory of a closed-loop run, in the form that its kernels use.

A run allocates no memory. Its kernels work on records that are made before the run. A record is a
NumPy structured scalar. Its fields are numbers, arrays of fixed size, and further records. Numba
compiles a kernel for the types of its arguments, and the type of a record includes all sizes of the
robot. The same compiled kernels thus serve every robot of the same sizes, and the compiler knows
every length. `LAYOUT` lists the fields, `_lengths` gives the length of each dimension, and
`record_type` makes a NumPy type from both.

The order of fields matters where a comment states it: a function of a robot (`robot.functions`)
writes its outputs one after the other, directly into the fields of a record.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dynamics.closed_loop.command_schedule import CommandSchedule
from dynamics.closed_loop.joints import FRICTION
from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from dynamics.closed_loop.problem import LoopProblem, Sizes
from dynamics.parameters import LANES, room_for_derivatives

CACHE_LINE = 64  # bytes in a line of the processor's cache


class Plan(NamedTuple):
    """Arrays that a run reads. Most have one row per frame; those named start_* are for the start.

    Optional arrays that are missing have no rows.
    """

    reference: np.ndarray
    reference_rate: np.ndarray
    commands: np.ndarray
    directions: np.ndarray
    start_directions: np.ndarray
    feedforward: np.ndarray
    lost: np.ndarray
    noise: np.ndarray
    start_commands: np.ndarray
    start_integral_sensitivity: np.ndarray
    start_servo_sensitivity: np.ndarray
    start_command_sensitivity: np.ndarray
    spans: CommandSchedule


class Record(NamedTuple):
    """Arrays that a run writes, as in `ClosedLoopRun`, with coordinates in place of poses."""

    pose: np.ndarray
    pose_rate: np.ndarray
    torque: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    measured_ok: np.ndarray
    joint_integral: np.ndarray
    servo_integral: np.ndarray
    pose_sensitivity: np.ndarray
    start_sensitivity: np.ndarray
    command_sensitivity: np.ndarray
    end_sensitivity: np.ndarray
    end_start_sensitivity: np.ndarray
    motor_angle: np.ndarray
    motor_rate: np.ndarray
    filtered_rate: np.ndarray


def empty_record(problem: LoopProblem, runs: int = 1) -> Record:
    """Record of several runs, filled with zeros. The rows of the runs follow one after the other.

    Arrays of results that are not requested have no rows or no columns.
    """
    sizes = problem.sizes
    frames = runs * problem.frames
    joints = sizes.joints
    coordinates = sizes.coordinates
    parameters = len(problem.columns) if problem.sensitivities else 0
    start = sizes.start if problem.start_sensitivities else 0
    directions = problem.further_columns - start
    elastic_frames = frames if problem.settings.elasticity else 0
    filtered_frames = frames if sizes.filters else 0
    return Record(
        pose=np.zeros((frames, coordinates)),
        pose_rate=np.zeros((frames, coordinates)),
        torque=np.zeros((frames, joints)),
        command=np.zeros((frames, joints)),
        measured=np.zeros((frames, coordinates)),
        measured_ok=np.zeros(frames, bool),
        joint_integral=np.zeros((frames, joints)),
        servo_integral=np.zeros((frames, coordinates)),
        pose_sensitivity=np.zeros((frames, coordinates, parameters)),
        start_sensitivity=np.zeros((frames, coordinates, start)),
        command_sensitivity=np.zeros((frames, coordinates, directions)),
        end_sensitivity=np.zeros((sizes.start, parameters)),
        end_start_sensitivity=np.zeros((sizes.start, start)),
        motor_angle=np.zeros((elastic_frames, joints)),
        motor_rate=np.zeros((elastic_frames, joints)),
        filtered_rate=np.zeros((filtered_frames, joints)),
    )


class Memory(NamedTuple):
    """Records of one run.

    `task` does not change during a run. It has laws, parameters, gains, and addresses of compiled
    functions. `now` is the state of the integrator. `evaluations` (5,) have the values computed at
    the four stages of a step and at its end. Their rows for stuck joints are in the order of
    `now.stuck`. `tangent` has derivatives, with a row for each unknown. Its columns belong to the
    parameters, then the start state or directions, then the length of a step that an event
    shortens. In kernels, `at` is `evaluations` or one of its entries, and `d` is `tangent`.
    """

    task: Any
    now: Any
    evaluations: np.ndarray
    tangent: Any


class Fields(NamedTuple):
    """Consecutive fields of a record with the same type and dimensions."""

    names: str
    kind: str
    dimensions: tuple[str, ...]


def reals(names: str, *dimensions: str) -> Fields:
    """Fields of real numbers. Without dimensions, each field is a single number."""
    return Fields(names, "f8", dimensions)


def integers(names: str, *dimensions: str) -> Fields:
    """Fields of integers. Without dimensions, each field is a single number."""
    return Fields(names, "i8", dimensions)


def record_field(name: str) -> Fields:
    """Field that is itself a record, whose layout has the same name."""
    return Fields(name, "record", ())


# Fields of each record. `factor` is the L D L^T factorisation of the mass matrix.
LAYOUT: dict[str, tuple[Fields, ...]] = {
    "task": (
        # addresses of functions of the robot, then of kernels
        integers("equation_of_motion motion_in_lanes free_acceleration acceleration_in_lanes"),
        integers("response stage_derivatives stop_derivatives rate_map_derivative"),
        integers("slope_derivative servo_jacobian"),
        integers("evaluate_terms evaluate decide_modes stop_joints slope_tangent stop_tangent"),
        # switches: compute derivatives, servo has the robot's geometry, Python has measured
        integers("sensitivities servo_knows measured"),
        # law of the drives, with its gains
        reals("lp li ld lx", "joint"),
        reals("lx_by", "joint", "gain"),
        reals("reads", "gain"),
        reals("rate_weight"),
        # commands as the drives receive them
        reals("command_scale command_step command_low command_high"),
        reals("joint_zero", "joint"),
        # number of columns from the gains of a joint to those of the next (0: shared gains)
        integers("gain_step"),
        # servo, elastic joints, timing, drives
        reals("kp kd ki stiffness damping motor_inertia period"),
        integers("torques"),
        reals("torque_limit filter_time"),
        # parameters; number and indices of those of rigid bodies that have a column of derivatives
        integers("shown"),
        integers("pivots", "rigid"),
        reals("rigid", "rigid"),
        reals("coulomb viscous", "joint"),
        record_field("friction"),
    ),
    "now": (
        record_field("stages"),
        record_field("known"),
        record_field("served"),
        record_field("stopping"),
        # mode of each joint (0: stuck, -1 or 1: direction of slip), indices of the stuck joints
        integers("mode stuck", "joint"),
        # counters and switches
        integers("ramping moved events events_left start_moves time_moves length_moves"),
        integers("width parameters step_column"),
        # state, commands and servo
        reals("elapsed"),
        reals("state", "state"),
        reals("command command_slope command_rate last_command", "joint"),
        reals("last_measured servo_integral demand change", "coordinate"),
        reals("pose_and_rate", "rate map input"),
        reals("rate_map", "joint", "coordinate"),
        # progress of the integrator: frame, span, step
        integers("first_row status unknowns frame span steps grid"),
        reals("duration target"),
        integers("purpose"),
        reals("length"),
        # search for an event within a step
        integers("trials"),
        reals("cut low high low_margin high_margin half_margin"),
        reals("tried tried_margin tried_crossing", "trial point"),
    ),
    "known": (
        # outputs of `equation_of_motion` in its order
        reals("mass", "coordinate", "coordinate"),
        reals("bias", "coordinate"),
        reals("jacobian", "joint", "coordinate"),
        reals("bias_acceleration angle velocity", "joint"),
        reals("factor", "coordinate", "coordinate"),
        reals("inputs", "motion input"),
        integers("valid"),
    ),
    "served": (
        reals("jacobian", "joint", "coordinate"),
        reals("inputs", "servo input"),
    ),
    "stages": (
        # outputs of `stage_derivatives` for all stages of a step
        reals("by_pose by_rate", "coordinate", "coordinate", "stage"),
        reals("columns", "coordinate", "rigid", "stage"),
        reals("crank_by_pose crank_by_rate", "joint", "coordinate", "stage"),
        # then the other values that all columns of `slope_derivative` have in common
        reals("jacobian pushing", "joint", "coordinate", "stage"),
        reals("factor", "coordinate", "coordinate", "stage"),
        reals("damping by_error by_integral by_command_rate", "joint", "stage"),
        reals("inputs", "stage input", "stage"),
    ),
    "stopping": (
        # outputs of `stop_derivatives`
        reals("by_pose by_rate", "coordinate", "coordinate"),
        reals("columns", "coordinate", "rigid"),
        reals("inputs", "stop input"),
    ),
    "evaluation": (
        # inputs of `response` and, from the factor on, of `free_acceleration`, in their order
        reals("row", "coordinate"),
        reals("factor", "coordinate", "coordinate"),
        reals("bias", "coordinate"),
        reals("jacobian", "joint", "coordinate"),
        reals("push", "joint"),
        # state and its time derivative
        reals("state slope", "state"),
        reals("time"),
        # joints; for elastic joints, angle and velocity are those of the motors
        reals("bias_acceleration angle velocity spring error torque net_torque", "joint"),
        reals("stick_force force", "joint"),
        # response of the platform and of the stuck joints to torques at stuck joints
        reals("response", "joint", "coordinate"),
        reals("compliance stuck_factor", "joint", "joint"),
    ),
    "lanes": (
        # inputs of `motion_in_lanes`, then its outputs; from the factor on, the inputs of
        # `acceleration_in_lanes`, then its outputs
        reals("states", "coordinate and rate", "lane"),
        reals("bias_acceleration angle velocity", "joint", "lane"),
        reals("factor", "coordinate", "coordinate", "lane"),
        reals("bias", "coordinate", "lane"),
        reals("jacobian", "joint", "coordinate", "lane"),
        reals("push", "joint", "lane"),
        reals("row acceleration response", "coordinate", "lane"),
        integers("asked", "lane"),
        reals("shared", "shared input"),
    ),
    "tangent": (
        # inputs of each column of `slope_derivative`
        reals("trial", "trial row", "column"),
        reals("acting command_rate", "joint", "column"),
        reals("push", "coordinate", "column"),
        reals("direct", "joint", "column"),
        # its outputs at each stage; slopes of filtered rates come before the torques
        reals("k", "stage", "stage row", "column"),
        # derivatives of the state, and of filtered rates in a trial
        reals("x", "unknown", "column"),
        reals("filtered", "filtered row", "column"),
        # derivatives of issued commands; the last entry is for the commands of the start
        reals("issued", "command on its way", "joint", "column"),
        reals("time length stage_time margin", "column"),
        reals("command command_slope last_command force", "joint", "column"),
        reals("last_measured integral demand moved", "coordinate", "column"),
    ),
}


def _lengths(sizes: Sizes) -> dict[str, int]:
    """Length of every dimension in `LAYOUT`."""
    joints = sizes.joints
    coordinates = sizes.coordinates
    filters = sizes.filters
    # the last inputs of a function of the robot are numbers of its geometry
    numbers = sizes.geometry
    fixed = sizes.rigid + numbers
    moving = 2 * coordinates + joints
    return {
        "joint": joints,
        "coordinate": coordinates,
        "coordinate and rate": 2 * coordinates,
        "rigid": sizes.rigid,
        "gain": 3,
        "stage": 4,
        "trial point": 4,
        "lane": LANES,
        # coordinates, rates, integrals, filtered rates, motor angles, motor rates
        "state": moving + filters + 2 * joints,
        # unknowns that have derivatives; joints are then rigid
        "unknown": moving + filters,
        "trial row": moving,
        "filtered row": max(filters, 1),
        # slopes of the pose, the pose rate, joint integrals and filtered rates; torques
        "stage row": moving + joints + filters,
        "column": room_for_derivatives(sizes.rigid, joints, coordinates),
        "command on its way": MAX_DELAY_FRAMES + 3,
        "servo input": coordinates + numbers,
        "rate map input": 2 * coordinates + numbers,
        "shared input": fixed,
        "motion input": 2 * coordinates + fixed,
        # coordinates, rates, accelerations, torques
        "stage input": 3 * coordinates + joints + fixed,
        # coordinates, accelerations, torques
        "stop input": moving + fixed,
    }


@lru_cache(maxsize=64)
def record_type(name: str, sizes: Sizes) -> np.dtype:
    """NumPy type of a record, for a robot of given sizes."""
    length = _lengths(sizes)
    fields: list[Any] = []
    for names, kind, dimensions in LAYOUT[name]:
        if kind == "record":
            fields.append((names, FRICTION if names == "friction" else record_type(names, sizes)))
            continue
        shape = tuple(length[dimension] for dimension in dimensions)
        fields += [(field, kind, shape) for field in names.split()]
    return np.dtype((np.record, fields))


def empty_memory(sizes: Sizes) -> Memory:
    """Memory for one run of a robot of given sizes, filled with zeros."""
    evaluations = np.zeros(5, record_type("evaluation", sizes))
    return Memory(empty("task", sizes), empty("now", sizes), evaluations, empty("tangent", sizes))


def empty(name: str, sizes: Sizes) -> Any:
    """Record filled with zeros. It begins where a line of the processor's cache begins.

    A vector instruction on its fields then accesses one line instead of two.
    """
    kind = record_type(name, sizes)
    space = np.zeros(kind.itemsize + CACHE_LINE, np.uint8)
    first = -space.ctypes.data % CACHE_LINE
    return space[first : first + kind.itemsize].view(kind)[0]
