"""Kernels of the drives: the received command, the joint PID, and the limit of its torque.

`drives` has the formula (eq. 31) and the laws.
"""

import numpy as np

from dynamics.compiled.kernel import Array, Record, kernel


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


@kernel
def received(task: Record, command: float, joint: int) -> float:
    """Command that a drive receives if `command` is sent. See `drives`."""
    if task.command_step > 0:
        command = task.command_step * np.rint(command / task.command_step)
    command = min(max(command, task.command_low), task.command_high)
    return task.command_scale * command + task.joint_zero[joint]


@kernel
def scale_received(task: Record, sent: Array, rows: Array, width: int) -> None:
    """Turn derivatives of sent commands (n,) into those of received commands, by their scale.

    The derivatives of a command that is cut at a limit are zero. Rounding to steps is ignored.
    """
    for i in range(len(rows)):
        inside = task.command_low <= sent[i] <= task.command_high
        scale = task.command_scale if inside else 0.0
        if scale != 1.0:
            for k in range(width):
                rows[i, k] *= scale
