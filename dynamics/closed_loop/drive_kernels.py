"""Law of the drives: the torque of each joint for its command. See `drives` for the formula."""

from dynamics.compiled.kernel import Record, kernel


@kernel
def drive(task: Record, now: Record, at: Record) -> None:
    """Compute the torques of the drives at an evaluation, where angles and velocities are known."""
    state = at.state
    count = len(at.angle)
    first = 2 * len(at.bias)
    time = at.time
    lp = task.lp
    li = task.li
    ld = task.ld
    for i in range(count):
        if task.stiffness > 0:
            # from here on the motors stand for the cranks in what joint PID and friction feel
            motor = state[len(state) - 2 * count + i]
            motor_rate = state[len(state) - count + i]
            wound = motor - at.angle[i]
            winding = motor_rate - at.velocity[i]
            at.spring[i] = task.stiffness * wound + task.damping * winding
            at.angle[i] = motor
            at.velocity[i] = motor_rate
        error = now.command[i] + now.command_slope[i] * time - at.angle[i]
        damped = ld * (task.rate_weight * now.command_rate[i] - at.velocity[i])
        if task.filter_time > 0:
            damped = ld * state[first + count + i]
        at.error[i] = error
        at.torque[i] = lp * error + damped + li * state[first + i]
        if task.lx > 0:
            at.torque[i] -= task.lx * at.angle[i]
        if task.torques:
            at.torque[i] = now.command[i] + now.command_slope[i] * time
            at.error[i] = 0.0
        if task.torque_limit > 0:
            at.torque[i] = min(max(at.torque[i], -task.torque_limit), task.torque_limit)


@kernel
def follows_law(task: Record, at: Record, joint: int) -> float:
    """Return 1 where the law gives the torque, and 0 where it is commanded or at its limit."""
    if task.torques or (task.torque_limit > 0 and abs(at.torque[joint]) >= task.torque_limit):
        return 0.0
    return 1.0


@kernel
def winds_up(task: Record, at: Record, joint: int) -> bool:
    """Return True where a drive at its limit would integrate on.

    Its integrator then holds (conditional integration).
    """
    if task.torques or follows_law(task, at, joint) > 0:
        return False
    return bool((task.li * at.error[joint] - task.lx * at.velocity[joint]) * at.torque[joint] > 0)
