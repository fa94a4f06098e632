"""Kernels for sensitivities: exact derivatives of what the integrator computes.

The derivatives of a quantity are a row whose columns belong to variables. The variables are the
parameters, then the start state or directions of the commands if requested. The length of a step
that an event shortens is the final variable, until its derivative is known. If inertial parameters
are in groups, only the pivots of the groups have a column.

A Runge-Kutta step is differentiated stage by stage, and the equation of motion at each stage is
differentiated implicitly. A step that an event shortens ends where a margin is zero. The derivative
of its length follows from the derivative of the margin. The next step becomes shorter by as much as
this step becomes longer. The impulse that stops joints is differentiated implicitly, too.
"""

from dynamics.closed_loop.drive_kernels import follows_law, winds_up
from dynamics.closed_loop.linear_algebra_kernels import (
    add_product,
    clear,
    copy,
    copy_rows,
    fill,
    solve_rows,
)
from dynamics.closed_loop.motion_kernels import (
    OK,
    count_stuck,
    dry_level,
    dry_slope,
    hold_compliance,
    mode_margin,
)
from dynamics.compiled.kernel import (
    Array,
    Record,
    add_row,
    call,
    call_columns,
    entry,
    invoke,
    kernel,
)
from dynamics.parameters import LANES

# Runge-Kutta: time of each stage as a fraction of the step, weight of its slope, index of the end
FRACTION = (0.0, 0.5, 0.5, 1.0)
WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
END = 4
# rate of a margin, rad/s^2 or N m/s (m/s^2 or N/s), up to which an event keeps its time
NO_APPROACH = 1e-9


@kernel
def ask_derivatives(now: Record, at: Record, k: int) -> None:
    """Copy an evaluation to stage `k` of the inputs of `differentiate_stages`."""
    size = len(at.bias)
    inputs = now.stages.inputs
    for j in range(2 * size):
        inputs[j, k] = at.state[j]
    for j in range(size):
        inputs[2 * size + j, k] = at.slope[size + j]
    for i in range(len(now.mode)):
        inputs[3 * size + i, k] = at.net_torque[i]


@kernel
def differentiate_stages(task: Record, now: Record) -> None:
    """Differentiate the motion at all stages, at fixed accelerations and net joint torques."""
    call(task.stage_derivatives, now.stages.inputs, now.stages.by_pose)


@kernel
def share_with_columns(task: Record, now: Record, at: Record, k: int) -> None:
    """Copy the values that all columns of a slope need, besides derivatives of the motion."""
    stages = now.stages
    size = len(at.bias)
    for i in range(size):
        for j in range(size):
            stages.factor[i, j, k] = at.factor[i, j]
    filtering = task.filter_time > 0
    for i in range(len(now.mode)):
        mode = now.mode[i]
        slips = now.mode[i] != 0
        active = follows_law(task, at, i)
        stages.by_error[i, k] = active * (task.lp[i] + task.lx[i])
        stages.by_integral[i, k] = active * task.li[i]
        stages.by_command_rate[i, k] = 0.0 if filtering else active * task.rate_weight * task.ld[i]
        stages.damping[i, k] = 0.0 if filtering else active * task.ld[i]
        if slips:
            stages.damping[i, k] += task.viscous[i] + task.coulomb[i] * dry_slope(
                task.friction, at.velocity[i], mode
            )
        for j in range(size):
            stages.jacobian[i, j, k] = at.jacobian[i, j]
            stages.pushing[i, j, k] = at.jacobian[i, j] if slips else 0.0


@kernel
def fixed_state_tangent(task: Record, now: Record, at: Record, d: Record, stage: int) -> None:
    """Differentiate forces and torques with respect to the parameters at a fixed state.

    `d.push` is the derivative of -M q_ddot - b. `d.direct` is the derivative of the torque of each
    joint, without the friction torque of a stuck joint.
    """
    count = len(now.mode)
    first = 2 * len(at.bias)
    rigid = task.shown
    for i in range(len(at.bias)):
        for k in range(rigid):
            d.push[i, k] = -now.stages.columns[i, task.pivots[k], stage]
    for i in range(count):
        lp = rigid + 2 * count + task.gain_step * i
        mode = now.mode[i]
        row = d.direct[i]
        active = follows_law(task, at, i)
        rate = task.rate_weight * now.command_rate[i] - at.velocity[i]
        if task.lx[i] > 0 or task.filter_time > 0:
            fill(row, 0.0)
            # `by_error` is lp + lx, but lx does not act on the command: its effect is subtracted
            add_row(-active * task.lx[i], d.acting[i], row, now.width)
        if task.filter_time > 0:
            rate = at.state[first + count + i]
            add_row(active * task.ld[i], d.filtered[i], row, now.width)
        for k in (lp, lp + 1, lp + 2, rigid + i, rigid + count + i):
            if task.lx[i] == 0 and task.filter_time == 0:
                row[k] = 0.0
        row[lp] += active * task.reads[0] * at.error[i]
        row[lp + 1] += active * task.reads[1] * at.state[first + i]
        row[lp + 2] += active * task.reads[2] * rate
        for k in range(3):
            row[lp + k] -= active * task.lx_by[i, k] * at.angle[i]
        row[rigid + i] -= dry_level(task.friction, at.velocity[i], mode) if mode != 0 else 0.0
        row[rigid + count + i] -= at.velocity[i] if mode != 0 else 0.0


@kernel
def filtered_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> None:
    """Differentiate the slopes of filtered rates, which precede the torques in `d.k[k]`."""
    size = len(at.bias)
    count = len(now.mode)
    width = now.width
    first = 2 * size + count
    slopes = d.k[k, first : first + count]
    torque = d.k[k, first + count :]
    copy_rows(slopes, torque, width)
    clear(slopes, width)
    # `crank_by_rate` is d(joint acceleration)/d(rate), twice d(joint velocity)/d(pose)
    for i in range(count):
        for j in range(size):
            add_row(
                -0.5 / task.filter_time * now.stages.crank_by_rate[i, j, k],
                d.trial[j],
                slopes[i],
                width,
            )
    add_product(-1 / task.filter_time, at.jacobian, d.trial[size : 2 * size], slopes, width)
    for i in range(count):
        add_row(task.rate_weight / task.filter_time, d.command_rate[i], slopes[i], width)
        add_row(-1 / task.filter_time, d.filtered[i], slopes[i], width)


@kernel
def held_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> None:
    """Differentiate the slopes lx / li * velocity of the integrals that `winds_up` holds."""
    size = len(at.bias)
    width = now.width
    stages = now.stages
    for i in range(len(now.mode)):
        if winds_up(task, at, i):
            lp = task.shown + 2 * len(now.mode) + task.gain_step * i
            row = d.k[k, 2 * size + i]
            ratio = task.lx[i] / task.li[i]
            fill(row, 0.0)
            for j in range(size):
                add_row(0.5 * ratio * stages.crank_by_rate[i, j, k], d.trial[j], row, width)
                add_row(ratio * at.jacobian[i, j], d.trial[size + j], row, width)
            for gain in range(3):
                row[lp + gain] += task.lx_by[i, gain] / task.li[i] * at.velocity[i]
            row[lp + 1] -= ratio / task.li[i] * at.velocity[i]


@entry
def slope_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Write the derivatives of the slope and of the net torques at one state into `d.k[k]`.

    The derivatives of state, filtered rates and time are `d.trial`, `d.filtered` and
    `d.stage_time`. The derivatives of the equation of motion must have been computed. See
    `slope_derivative`.
    """
    size = len(at.bias)
    count = len(now.mode)
    width = now.width
    stages = now.stages
    pose = d.trial[:size]
    rate = d.trial[size : 2 * size]
    acceleration = d.k[k, size : 2 * size]
    torque = d.k[k, len(d.k[k]) - count :]
    share_with_columns(task, now, at, k)
    if now.ramping:
        copy_rows(d.command[:], d.acting[:], width)
        for i in range(count):
            add_row(at.time, d.command_slope[i], d.acting[i], width)
            add_row(now.command_slope[i], d.stage_time[:], d.acting[i], width)
    fixed_state_tangent(task, now, at, d, k)
    call_columns(task.slope_derivative, stages.by_pose[0, 0, k:], d.trial, d.k[k], width)
    if task.filter_time > 0:
        filtered_tangent(task, now, at, d, k)
    if task.torque_limit > 0:
        held_tangent(task, now, at, d, k)
    stuck = now.stuck[: count_stuck(now)]
    if len(stuck) == 0:
        return OK
    clear(d.force[:], width)
    for s in range(len(stuck)):
        for j in range(size):
            add_row(stages.crank_by_pose[stuck[s], j, k], pose[j], d.force[s], width)
            add_row(stages.crank_by_rate[stuck[s], j, k], rate[j], d.force[s], width)
            add_row(at.jacobian[stuck[s], j], acceleration[j], d.force[s], width)
    give_back(at, d, len(stuck), acceleration, width)
    for s in range(len(stuck)):
        add_row(1.0, d.force[s], torque[stuck[s]], width)
    return OK


@kernel
def give_back(at: Record, d: Record, stuck: int, rows: Array, width: int) -> None:
    """Solve for the torques of stuck joints (`d.force`), and subtract their effect from rows."""
    solve_rows(at.stuck_factor, stuck, d.force[:], width)
    for s in range(stuck):
        for j in range(len(rows)):
            add_row(-at.response[s, j], d.force[s], rows[j], width)


@kernel
def move_tangent(
    now: Record,
    at: Record,
    d: Record,
    stage: int,
    h: float,
    fraction: float,
    moved: Array,
    first: int,
) -> None:
    """Add fraction * (h * d_slope + d_length * slope) of a stage, from `first` on, to `moved`."""
    for i in range(len(moved)):
        add_row(fraction * h, d.k[stage, first + i], moved[i], now.width)
        if now.length_moves:
            add_row(fraction * at[stage].slope[first + i], d.length[:], moved[i], now.width)


@kernel
def try_tangent(now: Record, d: Record) -> None:
    """Set the derivatives of a stage to those at the start of the step."""
    count = len(d.trial)
    copy_rows(d.x[:count], d.trial[:], now.width)
    copy_rows(d.x[count:], d.filtered[:], now.width)


@kernel
def velocity_by_pose(task: Record, now: Record, pose: Array, rate: Array) -> None:
    """Compute d(J_theta rate)/d(pose) (n, m), and write it into `now.rate_map`."""
    copy(pose, now.pose_and_rate[: len(pose)])
    copy(rate, now.pose_and_rate[len(pose) :])
    call(task.rate_map_derivative, now.pose_and_rate, now.rate_map)


@kernel
def length_tangent(task: Record, now: Record, end: Record, d: Record) -> None:
    """Differentiate the length of a step that an event shortens.

    At this length, the margin is zero at the end of the step. The margin is the velocity of a
    slipping joint, or follows from the torque that holds a stuck joint.
    """
    size = len(end.bias)
    width = now.width
    column = now.step_column
    joint = mode_margin(task, now, end)[1]
    fill(d.margin[:], 0.0)
    if now.mode[joint] != 0:
        velocity_by_pose(task, now, end.state[:size], end.state[size : 2 * size])
        for j in range(size):
            add_row(now.rate_map[joint, j], d.x[j], d.margin[:], width)
            add_row(end.jacobian[joint, j], d.x[size + j], d.margin[:], width)
    else:
        copy(d.time[:], d.stage_time[:])
        d.stage_time[column] = 1.0
        try_tangent(now, d)
        ask_derivatives(now, end, 0)
        differentiate_stages(task, now)
        invoke(task.slope_tangent, task, now, end, d, 0)
        torque = d.k[0, len(d.k[0]) - len(now.mode) + joint]
        add_row(1.0 if end.stick_force[joint] > 0 else -1.0, torque, d.margin[:], width)
        # the breakaway torque grows with the Coulomb parameter of the joint
        d.margin[task.shown + joint] -= task.friction.static_level
    approach = d.margin[column]
    fill(d.length[:], 0.0)
    # if the margin hardly changes, the derivative of the length is meaningless, and set to zero
    if abs(approach) > NO_APPROACH:
        add_row(-1 / approach, d.margin[:], d.length[:], width)
    d.length[column] = 0.0
    for i in range(len(d.x)):
        # the length now depends on the other variables: its effect is added to their columns
        add_row(d.x[i, column], d.length[:], d.x[i], width)
        d.x[i, column] = 0.0


@kernel
def whole_vectors(columns: int) -> int:
    """Round a number of columns up to a multiple of LANES. Added columns are zero."""
    return -(-columns // LANES) * LANES


@kernel
def step_tangent(
    task: Record, now: Record, at: Record, d: Record, h: float, event: bool, cut: bool
) -> None:
    """Differentiate the step whose stages are in `at`.

    A step without an `event` ends at a planned time. The length of a step that is `cut` by an event
    is determined by the event. Until the derivative of this length is known, the length is a
    variable of its own. A step that ends at an event without being cut has a constant length.
    """
    fill(d.length[:], 0.0)
    if cut:
        now.width = whole_vectors(now.step_column + 1)
        d.length[now.step_column] = 1.0
    if not event:
        # the step ends at a planned time, and a later start makes it shorter
        add_row(-1.0, d.time[:], d.length[:], now.width)
    now.length_moves = cut or now.time_moves
    for k in range(END):
        ask_derivatives(now, at[k], k)
    differentiate_stages(task, now)
    for k in range(END):
        try_tangent(now, d)
        if k > 0:
            move_tangent(now, at, d, k - 1, h, FRACTION[k], d.trial[:], 0)
            first = len(d.trial)
            move_tangent(now, at, d, k - 1, h, FRACTION[k], d.filtered[: len(d.x) - first], first)
        copy(d.time[:], d.stage_time[:])
        add_row(FRACTION[k], d.length[:], d.stage_time[:], now.width)
        invoke(task.slope_tangent, task, now, at[k], d, k)
    for k in range(END):
        move_tangent(now, at, d, k, h, WEIGHT[k], d.x[:], 0)
    if cut:
        length_tangent(task, now, at[END], d)
        now.width = whole_vectors(now.step_column)
    add_row(1.0, d.length[:], d.time[:], now.width)
    now.time_moves = event


@entry
def stop_tangent(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Differentiate the stop of joints, which changed the pose rate by `now.change`.

    The equations are M change = -J^T impulse (`at.force`), and J rate = 0 at the stopped joints.
    """
    size = len(at.bias)
    width = now.width
    stopping = now.stopping
    stuck = now.stuck[: count_stuck(now)]
    pose = d.x[:size]
    rate = d.x[size : 2 * size]
    copy(now.state[:size], stopping.inputs[:size])
    copy(now.change[:], stopping.inputs[size : 2 * size])
    impulse = stopping.inputs[2 * size : 2 * size + len(now.mode)]
    fill(impulse, 0.0)
    for s in range(len(stuck)):
        impulse[stuck[s]] = -at.force[s]
    call(task.stop_derivatives, stopping.inputs, stopping.by_pose)
    clear(d.moved[:], width)
    for i in range(size):
        for k in range(task.shown):
            d.moved[i, k] = -stopping.columns[i, task.pivots[k]]
    add_product(-1.0, stopping.by_pose, pose, d.moved[:], width)
    solve_rows(at.factor, size, d.moved[:], width)
    for j in range(size):
        add_row(1.0, d.moved[j], rate[j], width)
    velocity_by_pose(task, now, now.state[:size], now.state[size : 2 * size])
    clear(d.force[:], width)
    for s in range(len(stuck)):
        for j in range(size):
            add_row(now.rate_map[stuck[s], j], pose[j], d.force[s], width)
            add_row(at.jacobian[stuck[s], j], rate[j], d.force[s], width)
    give_back(at, d, len(stuck), rate, width)
    return OK


@kernel
def rest_tangent(task: Record, now: Record, at: Record, d: Record) -> None:
    """Remove the part of the derivatives of the start's pose rate that would move stuck joints."""
    size = len(at.bias)
    stuck = now.stuck[: count_stuck(now)]
    if len(stuck) == size:
        clear(d.x[size : 2 * size], now.width)
    elif len(stuck) > 0:
        hold_compliance(task, at, stuck, 0)
        fill(at.force[:], 0.0)
        fill(now.change[:], 0.0)
        invoke(task.stop_tangent, task, now, at, d, 0)
