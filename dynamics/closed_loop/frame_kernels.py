"""Kernels that run the frames of a run: its start, the commands that act, and its record.

At the beginning of a frame, `visual_servo_kernels.issue_command` measures the pose and computes the
command. At a lost frame, it repeats the servo's command. The arguments `task`, `now`, `at`, `d`,
`plan` and `record` are explained in `run_memory`.
"""

from dynamics.closed_loop.drive_kernels import received, scale_received
from dynamics.closed_loop.linear_algebra_kernels import copy, copy_rows
from dynamics.closed_loop.motion_kernels import OK
from dynamics.closed_loop.stick_slip_kernels import (
    NO_MARGIN,
    begin_span,
    judge,
    next_step,
    try_step,
)
from dynamics.closed_loop.visual_servo_kernels import issue_command
from dynamics.compiled.kernel import Array, Record, entry, invoke, kernel


@kernel
def begin(task: Record, now: Record, at: Record, d: Record, plan: Record) -> None:
    """Set joint modes and derivatives at frame 0. Joints not faster than NO_MARGIN are at rest."""
    size = len(at[0].bias)
    count = len(now.mode)
    copy(now.state[:], at[0].state[:])
    now.span = -1
    # a failure is not reported here, because the first frame fails in the same way
    status = invoke(task.evaluate_terms, task, now, at[0], d, 0)
    for i in range(count):
        velocity = at[0].velocity[i]
        now.mode[i] = 0 if status != OK or abs(velocity) <= NO_MARGIN else 1 if velocity > 0 else -1
    if task.sensitivities:
        copy_rows(plan.start_integral_sensitivity, d.x[2 * size :], now.parameters)
        copy_rows(plan.start_servo_sensitivity, d.integral[:], now.parameters)
        issued = d.issued[len(d.issued) - 1]
        copy_rows(plan.start_command_sensitivity, issued, now.parameters)
        directions = plan.start_directions
        copy_rows(directions, issued[:, now.parameters :], directions.shape[1])
        newest = plan.start_commands[len(plan.start_commands) - 1]
        scale_received(task, newest, issued, now.width)
        # the servo's last command is then the newest command of the start
        if len(plan.commands) == 0 and len(plan.feedforward) == 0:
            copy_rows(plan.start_command_sensitivity, d.last_command[:], now.parameters)
    if now.start_moves:
        column = now.parameters
        for i in range(2 * size + count):
            d.x[i, column + i] = 1.0
        for i in range(size):
            d.integral[i, column + 2 * size + count + i] = 1.0


@kernel
def keep_state(task: Record, now: Record, d: Record, record: Record, k: int) -> None:
    """Record the state, and its derivatives, at a frame."""
    size = len(now.servo_integral)
    count = len(now.mode)
    row = now.first_row + k
    copy(now.state[:size], record.pose[row])
    copy(now.state[size : 2 * size], record.pose_rate[row])
    copy(now.servo_integral[:], record.servo_integral[row])
    copy(now.state[2 * size : 2 * size + count], record.joint_integral[row])
    if task.stiffness > 0:
        motors = len(now.state) - 2 * count
        copy(now.state[motors : motors + count], record.motor_angle[row])
        copy(now.state[motors + count :], record.motor_rate[row])
    if task.filter_time > 0:
        copy(now.state[2 * size + count : 2 * size + 2 * count], record.filtered_rate[row])
    if not task.sensitivities:
        return
    keep_rows(now, d.x[:size], record.pose_sensitivity[k], record.start_sensitivity[k])
    by_commands = record.command_sensitivity[k]
    copy_rows(d.x[:size, now.parameters :], by_commands, by_commands.shape[1])
    if k + 1 == len(record.pose):
        rows = 2 * size + count
        keep_rows(
            now, d.x[:rows], record.end_sensitivity[:rows], record.end_start_sensitivity[:rows]
        )
        keep_rows(
            now, d.integral[:], record.end_sensitivity[rows:], record.end_start_sensitivity[rows:]
        )


@kernel
def keep_rows(now: Record, rows: Array, by_parameters: Array, by_start: Array) -> None:
    """Record derivatives with respect to the parameters, and to the start state if requested."""
    copy_rows(rows, by_parameters, now.parameters)
    copy_rows(rows[:, now.parameters :], by_start, by_start.shape[1])


@kernel
def command_of(start: Array, commands: Array, number: int, joint: int) -> float:
    """Command of a joint that frame `number` issued. -1 is the newest from before the start."""
    return commands[number, joint] if number >= 0 else start[max(0, len(start) + number), joint]


@kernel
def apply_command(
    task: Record, now: Record, d: Record, start: Array, commands: Array, number: int, ramp: float
) -> None:
    """Set the command that acts from now on: the one that frame `number` issued.

    `ramp` is the fraction of the ramp from the previous command that is already done. At 1, the
    command is constant.
    """
    now.ramping = ramp < 1
    for i in range(len(now.command)):
        value = received(task, command_of(start, commands, number, i), i)
        before = received(task, command_of(start, commands, number - 1, i), i)
        change = value - before
        now.command_rate[i] = change / task.period
        now.command[i] = before + ramp * change if now.ramping else value
        now.command_slope[i] = now.command_rate[i] if now.ramping else 0.0
    if not task.sensitivities:
        return
    # the last entry of `d.issued` is for the commands from before the start
    rows = len(d.issued) - 1
    newer = d.issued[number % rows if number >= 0 else rows]
    older = d.issued[(number - 1) % rows if number > 0 else rows]
    for i in range(len(now.command)):
        for k in range(now.width):
            change = newer[i, k] - older[i, k]
            d.command_rate[i, k] = change / task.period
            d.command[i, k] = older[i, k] + ramp * change if now.ramping else newer[i, k]
            d.command_slope[i, k] = d.command_rate[i, k] if now.ramping else 0.0
    copy_rows(d.command[:], d.acting[:], now.width)


@kernel
def next_span(
    task: Record, now: Record, at: Record, d: Record, plan: Record, record: Record
) -> int:
    """Go on to the next span of a frame, or to the next frame, which begins with a measurement.

    No motion follows the last frame, whose spans are only evaluated.
    """
    spans = plan.spans
    k = now.frame
    final = now.frame + 2 == len(plan.spans.first)
    commands = record.command[now.first_row :]
    if now.span == spans.first[k + 1]:
        now.frame = k + 1
        now.span = -1
        return OK
    if now.span < 0:
        keep_state(task, now, d, record, k)
        status = issue_command(task, now, d, plan, record, k)
        if status != OK:
            return status
        now.span = spans.first[k]
    span = now.span
    now.span = span + 1
    now.grid = 0
    now.steps = 0
    now.target = 0.0
    apply_command(
        task, now, d, plan.start_commands, commands, spans.command[span], spans.ramp[span]
    )
    copy(now.state[:], at[0].state[:])
    at[0].time = 0.0
    status = invoke(task.evaluate_terms, task, now, at[0], d, 0)
    if span == spans.first[k]:
        copy(at[0].torque[:], record.torque[now.first_row + k])
    if status == OK and not final:
        begin_span(task, now, at, d, spans.duration[span], spans.steps[span])
    return status


@entry
def run_frames(
    tasks: Array,
    nows: Array,
    at: Record,
    tangents: Array,
    plan: Record,
    record: Record,
    first: int,
    last: int,
) -> tuple[int, int]:
    """Run the frames from `first` up to, but not including, `last`.

    Returns the status, and the frame at which it arose, or `last`. The memory is passed as arrays
    of one record each, because passing a record from Python takes 8 us, and a run with a sensor in
    Python calls this function at every frame.
    """
    task = tasks[0]
    now = nows[0]
    d = tangents[0]
    if first == 0:
        begin(task, now, at, d, plan)
    status = OK
    while status == OK and now.frame < last:
        if next_step(now, at):
            status = try_step(task, now, at, d)
            if status == OK:
                status = judge(task, now, at, d)
        else:
            status = next_span(task, now, at, d, plan, record)
    return status, now.frame
