"""Sensitivities over the steps of the integrator, the exact derivative of what it computes.

Derivatives are rows over columns: the parameters, the length of the present step, and the start state if wanted. A
Runge-Kutta step is differentiated stage by stage, the equation of motion at each implicitly. A step that an event cuts
has the length at which a margin vanishes at its end; the margin's derivative gives that of the length, and the step
that follows is shorter by it. Stopping joints by an impulse is differentiated implicitly too.
"""

from dynamics.closed_loop.linear_algebra_kernels import (
    add_product,
    add_row,
    clear,
    copy,
    copy_rows,
    fill,
    solve_rows,
)
from dynamics.closed_loop.motion_kernels import (
    OK,
    dry_level,
    dry_slope,
    follows_law,
    hold_compliance,
    mode_margin,
    stuck_joints,
)
from dynamics.compiled.kernel import Array, Record, call, entry, invoke, kernel

FRACTION = (0.0, 0.5, 0.5, 1.0)
WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
END = 4
NO_APPROACH = 1e-9  # rad/s^2 or N m/s: an event so slow has no derivative


@kernel
def differentiate_motion(
    task: Record, now: Record, pose: Array, rate: Array, acceleration: Array, torque: Array
) -> None:
    """Derivatives of the equation of motion at fixed acceleration and net joint torque."""
    size, known = len(pose), now.derivatives
    copy(pose, known.inputs[:size])
    copy(rate, known.inputs[size : 2 * size])
    copy(acceleration, known.inputs[2 * size : 3 * size])
    copy(torque, known.inputs[3 * size :])
    call(task.motion_derivatives, known.inputs, known.by_pose)


@kernel
def torque_tangent(task: Record, now: Record, at: Record, d: Record, x: Array, d_error: Array) -> None:
    """Derivative of the net torque of every joint; for stuck joints without the friction that holds them."""
    count, first, width = len(now.mode), 2 * len(at.bias), now.width
    coulomb, viscous = len(task.rigid), len(task.rigid) + count
    lp = viscous + count
    clear(d.torque[:], width)
    for i in range(count):
        law, mode, row = follows_law(task, at, i), now.mode[i], d.torque[i]
        damping = law * task.ld if task.filter_time == 0 else 0.0
        if mode != 0:
            damping += task.viscous[i] + task.coulomb[i] * dry_slope(task.friction, at.velocity[i], mode)
        add_row(law * task.lp, d_error[i], row, width)
        if task.filter_time > 0:
            add_row(law * task.ld, x[first + count + i], row, width)
        else:
            add_row(law * task.rate_weight * task.ld, d.command_rate[i], row, width)
        add_row(-damping, d.velocity[i], row, width)
        add_row(law * task.li, x[first + i], row, width)
        row[lp] += law * task.reads[0] * at.error[i]
        row[lp + 1] += law * task.reads[1] * at.state[first + i]
        rate = task.rate_weight * now.command_rate[i] - at.velocity[i]
        row[lp + 2] += law * task.reads[2] * (rate if task.filter_time == 0 else at.state[first + count + i])
        if task.lx > 0:
            for j in range(len(at.bias)):
                add_row(-law * task.lx * at.jacobian[i, j], x[j], row, width)
            for j in range(3):
                row[lp + j] -= law * task.lx_by[j] * at.angle[i]
        if mode != 0:
            row[coulomb + i] -= dry_level(task.friction, at.velocity[i], mode)
            row[viscous + i] -= at.velocity[i]


@kernel
def filtered_tangent(task: Record, now: Record, d: Record, filtered: Array, out: Array) -> None:
    """Derivative of the slope of the filtered rates of the errors."""
    clear(out, now.width)
    for i in range(len(now.mode)):
        add_row(task.rate_weight / task.filter_time, d.command_rate[i], out[i], now.width)
        add_row(-1 / task.filter_time, d.velocity[i], out[i], now.width)
        add_row(-1 / task.filter_time, filtered[i], out[i], now.width)


@entry
def slope_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Derivative of the slope at one state, into `d.k[k]`: implicitly, for those of the state and the time in `d.trial`
    and `d.stage_time`. Also that of the net torques, into `d.torque`.
    """
    x, out = d.trial[:], d.k[k]
    size, count, width, known = len(at.bias), len(now.mode), now.width, now.derivatives
    pose, rate = x[:size], x[size : 2 * size]
    d_acceleration, d_error = out[size : 2 * size], out[2 * size : 2 * size + count]
    state = at.state
    differentiate_motion(task, now, state[:size], state[size : 2 * size], at.slope[size : 2 * size], at.net_torque[:])
    copy_rows(rate, out[:size], width)
    copy_rows(d.command[:], d_error, width)
    for i in range(count):
        if now.ramping:
            add_row(at.time, d.command_slope[i], d_error[i], width)
            add_row(now.command_slope[i], d.stage_time[:], d_error[i], width)
    clear(d.velocity[:], width)
    add_product(-1.0, at.jacobian, pose, d_error, width)
    add_product(0.5, known.crank_by_rate, pose, d.velocity[:], width)
    add_product(1.0, at.jacobian, rate, d.velocity[:], width)
    torque_tangent(task, now, at, d, x, d_error)
    if task.filter_time > 0:
        filtered_tangent(task, now, d, x[2 * size + count :], out[2 * size + count :])
    clear(d_acceleration, width)
    for i in range(size):
        add_row(-1.0, known.columns[i], d_acceleration[i], len(task.rigid))
    add_product(-1.0, known.by_pose, pose, d_acceleration, width)
    add_product(-1.0, known.by_rate, rate, d_acceleration, width)
    for i in range(count):
        if now.mode[i] != 0:
            for j in range(size):
                add_row(at.jacobian[i, j], d.torque[i], d_acceleration[j], width)
    solve_rows(at.factor, size, d_acceleration, width)
    stuck = stuck_joints(now)
    clear(d.force[:], width)
    for s in range(len(stuck)):
        for j in range(size):
            add_row(known.crank_by_pose[stuck[s], j], pose[j], d.force[s], width)
            add_row(known.crank_by_rate[stuck[s], j], rate[j], d.force[s], width)
            add_row(at.jacobian[stuck[s], j], d_acceleration[j], d.force[s], width)
    give_back(at, d, len(stuck), d_acceleration, width)
    for s in range(len(stuck)):
        add_row(1.0, d.force[s], d.torque[stuck[s]], width)
    return OK


@kernel
def give_back(at: Record, d: Record, stuck: int, rows: Array, width: int) -> None:
    """Solve for what holds stuck joints (`d.force`), and take its effect out of the rows of the platform."""
    solve_rows(at.stuck_factor, stuck, d.force[:], width)
    for s in range(stuck):
        for j in range(len(rows)):
            add_row(-at.response[s, j], d.force[s], rows[j], width)


@kernel
def tangent_moved(now: Record, at: Record, d: Record, stage: int, h: float, fraction: float, out: Array) -> None:
    """out = x + fraction (h slope's derivative + d_length slope) at a stage."""
    for i in range(len(out)):
        for k in range(now.width):
            out[i, k] = d.x[i, k] + fraction * h * d.k[stage, i, k]
        if now.length_moves:
            add_row(fraction * at[stage].slope[i], d.length[:], out[i], now.width)


@kernel
def velocity_by_pose(task: Record, now: Record, pose: Array, rate: Array) -> Array:
    """d(J_theta rate)/d(pose) (n, m)."""
    copy(pose, now.pose_and_rate[: len(pose)])
    copy(rate, now.pose_and_rate[len(pose) :])
    call(task.rate_map_derivative, now.pose_and_rate, now.rate_map)
    return now.rate_map


@kernel
def length_tangent(task: Record, now: Record, end: Record, d: Record) -> None:
    """The event sets the length of the step that it cuts: margin(end of the step, its length) = 0. The margin is that
    of a velocity, or of what a stuck joint holds."""
    size, width, column, joint = len(end.bias), now.width, now.step_column, mode_margin(task, now, end)[1]
    fill(d.margin[:], 0.0)
    if now.mode[joint] != 0:
        by_pose = velocity_by_pose(task, now, end.state[:size], end.state[size : 2 * size])
        for j in range(size):
            add_row(by_pose[joint, j], d.x[j], d.margin[:], width)
            add_row(end.jacobian[joint, j], d.x[size + j], d.margin[:], width)
    else:
        copy(d.time[:], d.stage_time[:])
        d.stage_time[column] = 1.0
        copy_rows(d.x[:], d.trial[:], width)
        invoke(task.slope_tangent, task, now, end, d, 0)
        add_row(1.0 if end.stick_force[joint] > 0 else -1.0, d.torque[joint], d.margin[:], width)
        d.margin[len(task.rigid) + joint] -= task.friction.static_level
    approach = d.margin[column]
    fill(d.length[:], 0.0)
    if abs(approach) > NO_APPROACH:
        add_row(-1 / approach, d.margin[:], d.length[:], width)
    d.length[column] = 0.0
    for i in range(len(d.x)):
        add_row(d.x[i, column], d.length[:], d.x[i], width)
        d.x[i, column] = 0.0


@kernel
def step_tangent(task: Record, now: Record, at: Record, d: Record, h: float, event: bool, cut: bool) -> None:
    """Sensitivities over the stored step. One that ends on the grid is shorter by what its start is later; one that is
    `cut` by an event has the length that the event sets: until that is known it is one more variable."""
    fill(d.length[:], 0.0)
    if cut:
        d.length[now.step_column] = 1.0
    if not event:
        add_row(-1.0, d.time[:], d.length[:], now.width)
    now.length_moves = cut or now.time_moves
    for k in range(4):
        if k == 0:
            copy_rows(d.x[:], d.trial[:], now.width)
        else:
            tangent_moved(now, at, d, k - 1, h, FRACTION[k], d.trial[:])
        copy(d.time[:], d.stage_time[:])
        add_row(FRACTION[k], d.length[:], d.stage_time[:], now.width)
        invoke(task.slope_tangent, task, now, at[k], d, k)
    for k in range(4):
        tangent_moved(now, at, d, k, h, WEIGHT[k], d.x[:])
    if cut:
        length_tangent(task, now, at[END], d)
    add_row(1.0, d.length[:], d.time[:], now.width)
    now.time_moves = event


@entry
def stop_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Derivative of stopping joints, which changed the pose rate by `now.change` and left it in `now.state`.

    M change = -J^T impulse (`at.force`) and J rate = 0 in these joints, differentiated implicitly.
    """
    size, width, known, stuck = len(at.bias), now.width, now.derivatives, stuck_joints(now)
    pose, rate = d.x[:size], d.x[size : 2 * size]
    fill(now.rest[:], 0.0)
    fill(now.impulse[:], 0.0)
    clear(d.moved[:], width)
    differentiate_motion(task, now, now.state[:size], now.rest[:], now.rest[:], now.impulse[:])
    copy_rows(known.columns, d.moved[:], len(task.rigid))
    add_product(1.0, known.by_pose, pose, d.moved[:], width)
    for s in range(len(stuck)):
        now.impulse[stuck[s]] = -at.force[s]
    differentiate_motion(task, now, now.state[:size], now.rest[:], now.change[:], now.impulse[:])
    for i in range(size):
        add_row(-1.0, known.columns[i], d.moved[i], len(task.rigid))  # the difference leaves out gravity
    add_product(-1.0, known.by_pose, pose, d.moved[:], width)
    solve_rows(at.factor, size, d.moved[:], width)
    for j in range(size):
        add_row(1.0, d.moved[j], rate[j], width)
    by_pose = velocity_by_pose(task, now, now.state[:size], now.state[size : 2 * size])
    clear(d.force[:], width)
    for s in range(len(stuck)):
        for j in range(size):
            add_row(by_pose[stuck[s], j], pose[j], d.force[s], width)
            add_row(at.jacobian[stuck[s], j], rate[j], d.force[s], width)
    give_back(at, d, len(stuck), rate, width)
    return OK


@kernel
def rest_tangent(task: Record, now: Record, at: Record, d: Record) -> None:
    """A start state moved at joints that stick: their velocities are lost at once, without a path."""
    size, stuck = len(at.bias), stuck_joints(now)
    if len(stuck) == size:
        clear(d.x[size : 2 * size], now.width)
    elif len(stuck) > 0:
        hold_compliance(at, stuck)
        fill(at.force[:], 0.0)
        fill(now.change[:], 0.0)
        invoke(task.stop_tangent, task, now, at, d, 0)
