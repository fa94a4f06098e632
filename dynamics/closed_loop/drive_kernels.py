"""Kernels of the drives: the joint PID, its torque limit, and its conditional integration.

`drives` has the formula (eq. 31) and the laws.
"""

from dynamics.compiled.kernel import Record, kernel


@kernel
def drive(task: Record, now: Record, at: Record) -> None:
    """Compute the torques of the drives from the angles and velocities of an evaluation.

    If the joints are elastic, also compute the torques of the springs, and replace the angles and
    velocities of the joints by those of the motors.
    """
    state = at.state
    count = len(at.angle)
    integrals = 2 * len(at.bias)
    time = at.time
    for i in range(count):
        ld = task.ld[i]
        if task.stiffness > 0:
            # joint PID and friction act on the motors, not on the cranks
            motor = state[len(state) - 2 * count + i]
            motor_rate = state[len(state) - count + i]
            deflection = motor - at.angle[i]
            deflection_rate = motor_rate - at.velocity[i]
            at.spring[i] = task.stiffness * deflection + task.damping * deflection_rate
            at.angle[i] = motor
            at.velocity[i] = motor_rate
        error = now.command[i] + now.command_slope[i] * time - at.angle[i]
        rate_term = ld * (task.rate_weight * now.command_rate[i] - at.velocity[i])
        if task.filter_time > 0:
            rate_term = ld * state[integrals + count + i]
        at.error[i] = error
        at.torque[i] = task.lp[i] * error + rate_term + task.li[i] * state[integrals + i]
        if task.lx[i] > 0:
            at.torque[i] -= task.lx[i] * at.angle[i]
        # A law that commands torques replaces the joint PID, whose error is then not integrated.
        if task.torques:
            at.torque[i] = now.command[i] + now.command_slope[i] * time
            at.error[i] = 0.0
        # The limit comes last, because it applies to the torque of any law.
        if task.torque_limit > 0:
            at.torque[i] = min(max(at.torque[i], -task.torque_limit), task.torque_limit)


@kernel
def follows_law(task: Record, at: Record, joint: int) -> float:
    """Return 1 if the torque of a joint follows its PID, 0 if it is commanded or at its limit."""
    if task.torques or (task.torque_limit > 0 and abs(at.torque[joint]) >= task.torque_limit):
        return 0.0
    return 1.0


@kernel
def winds_up(task: Record, at: Record, joint: int) -> bool:
    """Return True if conditional integration holds the part li z - lx theta of a torque.

    The drive is then at its limit, and this part would change in the direction of the torque.
    """
    if task.torques or follows_law(task, at, joint) > 0:
        return False
    growth = task.li[joint] * at.error[joint] - task.lx[joint] * at.velocity[joint]
    return bool(growth * at.torque[joint] > 0)
