"""What the kernels of the loop work on: records of fixed size, laid out for the joints, coordinates and parameters of a
robot, and the arrays that a run reads and writes.
"""

import re
from collections import namedtuple
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from dynamics.closed_loop.command_schedule import CommandSchedule
from dynamics.closed_loop.joints import FRICTION
from dynamics.closed_loop.problem import MAX_DELAY_FRAMES, LoopProblem, Sizes
from dynamics.parameters import LANES, room_for_derivatives

LINE = 64
"""Bytes in a line of a processor's cache."""


class Plan(NamedTuple):
    """What a run reads at its frames, one row each; no rows where that is not given."""

    reference: np.ndarray
    reference_rate: np.ndarray
    commands: np.ndarray
    feedforward: np.ndarray
    lost: np.ndarray
    noise: np.ndarray
    start_commands: np.ndarray
    start_integral_sensitivity: np.ndarray
    start_servo_sensitivity: np.ndarray
    start_command_sensitivity: np.ndarray
    spans: CommandSchedule


RECORDED = (
    "pose:fm pose_rate:fm torque:fn command:fn measured:fm measured_ok:f joint_integral:fn servo_integral:fm "
    "pose_sensitivity:fmp start_sensitivity:fms end_sensitivity:Sp end_start_sensitivity:Ss "
    "motor_angle:en motor_rate:en filtered_rate:Fn"
)
"""What a run writes (see `ClosedLoopRun`), with its dimensions by their letters (see `empty_record`)."""

Record: Any = namedtuple("Record", re.findall(r"(\w+):", RECORDED))  # type: ignore[misc]


def empty_record(problem: LoopProblem, runs: int = 1) -> Any:
    """Room for what runs write, one after the other; what is not asked for has no rows or no columns."""
    sizes, frames = problem.sizes, runs * problem.frames
    length = {"f": frames, "n": sizes.joints, "m": sizes.coordinates, "S": sizes.start}
    length["p"] = len(problem.columns) if problem.sensitivities else 0
    length["s"] = sizes.start if problem.start_sensitivities else 0
    length["e"] = frames if problem.settings.elasticity else 0
    length["F"] = frames if sizes.filters else 0
    shapes = [tuple(length[letter] for letter in letters) for letters in re.findall(r":(\w+)", RECORDED)]
    return Record(*[np.zeros(shape, bool if len(shape) == 1 else float) for shape in shapes])


class Memory(NamedTuple):
    """Room for one run. Its parts are records, described by `LAYOUT`, whose fields are arrays.

    task: what does not change: addresses of machine code and kernels, laws, parameters, gains. now: where the
    integrator stands. evaluations (5,): all that is known at the stages of a step and at its end; rows of stuck joints
    in their order. tangent: derivatives, one row an unknown, one column for each parameter, one for each entry of the
    start state, and one for the length of a step that an event cuts.
    """

    task: Any
    now: Any
    evaluations: np.ndarray
    tangent: Any


LAYOUT = {
    "task": "equation_of_motion! motion_in_lanes! free_acceleration! acceleration_in_lanes! response! "
    "stage_derivatives! stop_derivatives! rate_map_derivative! slope_derivative! servo_jacobian! evaluate_terms! "
    "evaluate! decide_modes! stop_joints! slope_tangent! stop_tangent! sensitivities! servo_knows! measured! lp li "
    "ld lx rate_weight lx_by:3 reads:3 kp kd ki stiffness damping motor_inertia period torques! torque_limit "
    "filter_time shown! pivots:r! rigid:r coulomb:n viscous:n friction=friction",
    "now": "stages=stages known=known served=served stopping=stopping mode:n! stuck:n! ramping! moved! events! "
    "events_left! start_moves! time_moves! length_moves! width! parameters! step_column! elapsed state:s command:n "
    "command_slope:n command_rate:n last_command:n last_measured:m servo_integral:m demand:m change:m "
    "pose_and_rate:M rate_map:nm first_row! status! unknowns! frame! span! steps! grid! duration target purpose! "
    "length trials! cut low high low_margin high_margin half_margin tried:4 tried_margin:4 tried_crossing:4",
    # first what `equation_of_motion` returns, in its order
    "known": "mass:mm bias:m jacobian:nm bias_acceleration:n angle:n velocity:n factor:mm inputs:i valid!",
    "served": "jacobian:nm inputs:j",
    # first what `stage_derivatives` returns of all stages of a step, and what else the columns of `slope_derivative`
    # share
    "stages": "by_pose:mm4 by_rate:mm4 columns:mr4 crank_by_pose:nm4 crank_by_rate:nm4 jacobian:nm4 pushing:nm4 "
    "factor:mm4 damping:n4 by_error:n4 by_integral:n4 by_command_rate:n4 inputs:d4",
    # first what `stop_derivatives` returns
    "stopping": "by_pose:mm by_rate:mm columns:mr inputs:z",
    # first what `response` and, from the factor on, `free_acceleration` take, in their order
    "evaluation": "row:m factor:mm bias:m jacobian:nm push:n state:s slope:s time bias_acceleration:n angle:n "
    "velocity:n spring:n error:n torque:n net_torque:n stick_force:n force:n response:nm compliance:nn "
    "stuck_factor:nn",
    # first what `motion_in_lanes` takes, then what it returns, and from the factor on what `acceleration_in_lanes` does
    "lanes": "states:BL bias_acceleration:nL angle:nL velocity:nL factor:mmL bias:mL jacobian:nmL push:nL row:mL "
    "acceleration:mL response:mL asked:L! shared:q",
    # first the rows of `slope_derivative`; k: what it returns of each stage,
    # and before the torques the slopes of filtered rates, whose trials are `filtered`
    "tangent": "trial:bw acting:nw command_rate:nw push:mw direct:nw k:4yw x:xw filtered:fw issued:cnw time:w "
    "length:w stage_time:w margin:w command:nw command_slope:nw last_command:nw force:nw last_measured:mw "
    "integral:mw demand:mw moved:mw",
}
"""Fields of the records: a name with its dimensions by their letters (see `record_type`), one number without. `!` marks
integers, `=` another record. Angle and velocity of elastic joints are those of the motors; the mass matrix is kept as
its factor; issued commands stay while they are on their way, the last one is of those of the start."""


@lru_cache(maxsize=64)
def record_type(name: str, sizes: Sizes) -> np.dtype:
    """Layout of a record for a robot."""
    n, m, r, f = sizes.joints, sizes.coordinates, sizes.rigid, sizes.filters
    length = {"n": n, "m": m, "r": r, "s": 2 * m + 3 * n + f, "x": 2 * m + n + f, "3": 3, "4": 4}
    length |= {"b": 2 * m + n, "f": max(f, 1), "y": 2 * m + 2 * n + f}
    g = sizes.geometry
    length |= {
        "B": 2 * m,
        "L": LANES,
        "M": 2 * m + g,
        "q": r + g,
        "i": 2 * m + r + g,
        "j": m + g,
        "d": 3 * m + n + r + g,
        "z": 2 * m + n + r + g,
        "w": room_for_derivatives(sizes.parameters, sizes.start),
        "c": MAX_DELAY_FRAMES + 3,
    }
    fields: list[Any] = []
    for entry in LAYOUT[name].split():
        field, _, inner = entry.partition("=")
        if inner:
            fields.append((field, FRICTION if inner == "friction" else record_type(inner, sizes)))
            continue
        field, _, shape = entry.rstrip("!").partition(":")
        fields.append((field, "i8" if entry.endswith("!") else "f8", tuple(length[letter] for letter in shape)))
    return np.dtype((np.record, fields))


def empty_memory(sizes: Sizes) -> Memory:
    """Room for one run."""
    task, now, tangent = (empty(name, sizes) for name in ("task", "now", "tangent"))
    return Memory(task, now, np.zeros(5, record_type("evaluation", sizes)), tangent)


def empty(name: str, sizes: Sizes) -> Any:
    """An empty record that begins where a line of the processor's cache does: vectors in it then lie in one line."""
    kind = record_type(name, sizes)
    room = np.zeros(kind.itemsize + LINE, np.uint8)
    first = -room.ctypes.data % LINE
    return room[first : first + kind.itemsize].view(kind)[0]
