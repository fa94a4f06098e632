"""Equation of motion at a state, for joints that slip one way (mode +1 or -1) or stick (mode 0).

The drives give the torque of each joint for its command; see `drives` for the formula. Stuck joints
carry the friction torque that keeps their acceleration zero. Which joints stick at rest is a
problem of friction torques with bounds. For friction and elastic joints see `joints`.
"""

import numpy as np

from dynamics.closed_loop.linear_algebra_kernels import copy, dot, factorise, fill, solve
from dynamics.compiled.kernel import Array, Record, call, entry, invoke, kernel

# places of the laws in `joints.LawName`
SMOOTHED = 1
STRIBECK = 2
OK, LEFT_REACH, SINGULAR_MASS, TOO_MANY_EVENTS, MEASURED_OUT_OF_REACH = range(5)


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
        # A law that sets torques replaces the joint PID, and its error is never integrated.
        if task.torques:
            at.torque[i] = now.command[i] + now.command_slope[i] * time
            at.error[i] = 0.0
        # The limit comes last: a drive cannot tell what asks for its torque.
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


@kernel
def dry_level(friction: Record, velocity: float, mode: int) -> float:
    """Ratio of dry friction to the Coulomb torque of a joint that slips at a velocity, rad/s."""
    if friction.law == SMOOTHED:
        return np.tanh(velocity / friction.smoothing_velocity)
    if friction.law == STRIBECK:
        ratio = velocity / friction.stribeck_velocity
        return mode * (1 + (friction.static_level - 1) * np.exp(-ratio * ratio))
    return mode * 1.0


@kernel
def dry_slope(friction: Record, velocity: float, mode: int) -> float:
    """Derivative of `dry_level` with respect to the velocity, s/rad."""
    if friction.law == SMOOTHED:
        dry = np.tanh(velocity / friction.smoothing_velocity)
        return (1 - dry * dry) / friction.smoothing_velocity
    if friction.law == STRIBECK:
        ratio = velocity / friction.stribeck_velocity
        fading = ratio / friction.stribeck_velocity * np.exp(-ratio * ratio)
        return -2 * mode * (friction.static_level - 1) * fading
    return 0.0


@kernel
def has_events(task: Record, joint: int) -> bool:
    """Return True where a joint can stick."""
    return task.friction.law != SMOOTHED and task.coulomb[joint] > 0


@kernel
def breakaway(task: Record, joint: int) -> float:
    """Largest torque, N m, that friction carries in a joint at rest."""
    return task.friction.static_level * task.coulomb[joint]


@kernel
def slip_friction(task: Record, joint: int, velocity: float, mode: int) -> float:
    """Friction torque, N m, of a joint that slips towards `mode`."""
    return (
        task.coulomb[joint] * dry_level(task.friction, velocity, mode)
        + task.viscous[joint] * velocity
    )


@kernel
def count_stuck(now: Record) -> int:
    """Number of joints that stick. They are the first ones in `now.stuck`."""
    count = 0
    for i in range(len(now.mode)):
        if now.mode[i] == 0:
            now.stuck[count] = i
            count += 1
    return count


@kernel
def all_finite(matrix: Array) -> bool:
    """Return True where no entry is infinite or NaN."""
    finite = True
    for row in matrix:
        for value in row:
            finite = finite and bool(np.isfinite(value))
    return finite


@kernel
def know_motion(task: Record, known: Record, state: Array) -> int:
    """Compute the equation of motion at coordinates and rates, unless it is known there.

    Steps and frames share their ends, so that it often is.
    """
    size = len(known.bias)
    same = known.valid
    for j in range(2 * size):
        same = same and known.inputs[j] == state[j]
    if same:
        return OK
    copy(state[: 2 * size], known.inputs[: 2 * size])
    call(task.equation_of_motion, known.inputs, known.mass)
    known.valid = True
    for i in range(size):
        known.valid = known.valid and 0 < known.factor[i, i] < np.inf
    if known.valid:
        return OK
    # entries are NaN out of reach; finite entries mean that masses or inertias are wrong
    return SINGULAR_MASS if all_finite(known.mass) else LEFT_REACH


@entry
def evaluate_terms(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Compute everything at the state and time of an evaluation that modes do not change."""
    status = know_motion(task, now.known, at.state[:])
    if status == OK:
        take_known(now.known, at)
        drive(task, now, at)
    return status


@kernel
def take_known(known: Record, at: Record) -> None:
    """Copy what is known of the platform into an evaluation."""
    count, size = known.jacobian.shape
    for i in range(size):
        at.bias[i] = known.bias[i]
        copy(known.factor[i], at.factor[i])
    for i in range(count):
        at.angle[i] = known.angle[i]
        at.velocity[i] = known.velocity[i]
        at.bias_acceleration[i] = known.bias_acceleration[i]
        copy(known.jacobian[i], at.jacobian[i])


@kernel
def hold_compliance(task: Record, at: Record, joints: Array, known: int) -> None:
    """Compute the response of the platform to torques at some joints, and of these joints to each
    other.

    The response M^-1 J^T has a row (m,) for each joint. Its first `known` rows are known already.
    The compliance J M^-1 J^T is factorised.
    """
    for s in range(len(joints)):
        if s >= known:
            copy(at.jacobian[joints[s]], at.row)
            call(task.response, at.row, at.response[s])
        for r in range(s + 1):
            at.compliance[s, r] = dot(at.jacobian[joints[r]], at.response[s])
            at.compliance[r, s] = at.compliance[s, r]
    factorise(at.compliance, len(joints), at.stuck_factor)


@kernel
def accelerate_freely(task: Record, at: Record, torque: Array, acceleration: Array) -> None:
    """Compute the acceleration (m,) of the platform under joint torques (n,)."""
    copy(torque, at.push)
    call(task.free_acceleration, at.factor, acceleration)


@kernel
def push(task: Record, now: Record, at: Record) -> None:
    """Compute net torques in the present modes, without those that hold stuck joints.

    The slope of the state is filled except for the acceleration that these torques give.
    """
    size = len(at.bias)
    count = len(at.angle)
    for i in range(count):
        at.stick_force[i] = 0.0
        at.net_torque[i] = at.torque[i]
        if now.mode[i] != 0:
            at.net_torque[i] -= slip_friction(task, i, at.velocity[i], now.mode[i])
    copy(at.state[size : 2 * size], at.slope[:size])
    for i in range(count):
        held = winds_up(task, at, i)
        at.slope[2 * size + i] = task.lx * at.velocity[i] / task.li if held else at.error[i]
    if task.filter_time > 0:
        for i in range(count):
            unfiltered = task.rate_weight * now.command_rate[i] - at.velocity[i]
            at.slope[2 * size + count + i] = (
                unfiltered - at.state[2 * size + count + i]
            ) / task.filter_time
    if task.stiffness > 0:
        motors = len(at.slope) - 2 * count
        copy(at.velocity[:], at.slope[motors : motors + count])
        for i in range(count):
            left = at.net_torque[i] - at.spring[i]
            at.slope[motors + count + i] = left / task.motor_inertia if now.mode[i] != 0 else 0.0
            # a stuck motor does not turn, and its friction takes what is left of its torque
            if now.mode[i] == 0:
                at.stick_force[i] = left
                at.net_torque[i] -= left


@kernel
def hold_stuck(task: Record, now: Record, at: Record, known: int) -> None:
    """Give stuck rigid joints the torque that keeps them at rest.

    The slope has the free acceleration before. For `known` see `hold_compliance`.
    """
    size = len(at.bias)
    stuck = now.stuck[: count_stuck(now)]
    if task.stiffness > 0 or len(stuck) == 0:
        return
    acceleration = at.slope[size : 2 * size]
    hold_compliance(task, at, stuck, known)
    # the torques of stuck joints make their accelerations zero, all of them together
    for s in range(len(stuck)):
        at.force[s] = dot(at.jacobian[stuck[s]], acceleration) + at.bias_acceleration[stuck[s]]
    solve(at.stuck_factor, len(stuck), at.force)
    for s in range(len(stuck)):
        at.stick_force[stuck[s]] = at.force[s]
        at.net_torque[stuck[s]] -= at.force[s]
        for j in range(size):
            acceleration[j] -= at.response[s, j] * at.force[s]
    if len(stuck) == size:
        # a robot that stands still stands still: rounding must not make it creep
        fill(acceleration, 0.0)


@kernel
def accelerate(task: Record, now: Record, at: Record) -> None:
    """Compute the slope of the state in the present modes."""
    size = len(at.bias)
    push(task, now, at)
    accelerate_freely(
        task, at, at.spring if task.stiffness > 0 else at.net_torque, at.slope[size : 2 * size]
    )
    hold_stuck(task, now, at, 0)


@entry
def evaluate(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Compute everything at the state and time of an evaluation, in the present modes."""
    status = invoke(task.evaluate_terms, task, now, at, d, 0)
    if status == OK:
        accelerate(task, now, at)
    return status


@kernel
def follow_frictionless(task: Record, now: Record, at: Record) -> bool:
    """Set the modes of joints without dry friction to the direction in which they move.

    Returns True where one of them has turned.
    """
    turns = False
    for i in range(len(now.mode)):
        mode = -1 if at.velocity[i] < 0 else 1
        if not has_events(task, i) and now.mode[i] != mode:
            now.mode[i] = mode
            turns = True
    return turns


@kernel
def all_hold(task: Record, now: Record, at: Record) -> bool:
    """Return True where no stuck joint is at its breakaway torque."""
    holds = True
    for i in range(len(now.mode)):
        holds = holds and (now.mode[i] != 0 or abs(at.stick_force[i]) < breakaway(task, i))
    return holds


@entry
def decide_modes(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Decide which of the joints at rest (mode 0) stick, and which way the others start.

    The friction torques are found by projected Gauss-Seidel iterations.
    """
    joints = now.stuck[: count_stuck(now)]
    # motors at rest do not feel each other
    if task.stiffness > 0:
        for i in joints:
            left = at.torque[i] - at.spring[i]
            now.mode[i] = 0 if abs(left) < breakaway(task, i) else 1 if left >= 0 else -1
    if task.stiffness > 0 or len(joints) == 0:
        return OK
    hold_compliance(task, at, joints, 0)
    for i in range(len(now.mode)):
        at.net_torque[i] = at.torque[i]
        if now.mode[i] != 0:
            at.net_torque[i] -= slip_friction(task, i, at.velocity[i], now.mode[i])
    size = len(at.bias)
    free = at.slope[size : 2 * size]
    accelerate_freely(task, at, at.net_torque, free)
    fill(at.force[:], 0.0)
    # The compliance is positive definite, so that the iterations converge.
    for _ in range(1000):
        change = 0.0
        for s in range(len(joints)):
            push = dot(at.jacobian[joints[s]], free) + at.bias_acceleration[joints[s]]
            for r in range(len(joints)):
                push -= at.compliance[s, r] * at.force[r]
            # each joint takes the friction that would stop it, as far as it has that
            limit = breakaway(task, joints[s])
            wanted = min(max(at.force[s] + push / at.compliance[s, s], -limit), limit)
            change = max(change, abs(wanted - at.force[s]))
            at.force[s] = wanted
        if change < 1e-15:
            break
    for s in range(len(joints)):
        sticks = abs(at.force[s]) < breakaway(task, joints[s])
        now.mode[joints[s]] = 0 if sticks else 1 if at.force[s] >= 0 else -1
    return OK


@kernel
def mode_margin(task: Record, now: Record, at: Record) -> tuple[float, int]:
    """Compute the margin of the modes, and the joint that has it, or -1.

    The margin is >= 0 while all modes hold.
    """
    least = 1.0
    joint = -1
    for i in range(len(now.mode)):
        if not has_events(task, i):
            continue
        margin = now.mode[i] * at.velocity[i]
        if now.mode[i] == 0:
            # a share of the breakaway torque, which is comparable between joints
            margin = 1 - abs(at.stick_force[i]) / breakaway(task, i)
        if margin < least:
            least = margin
            joint = i
    return least, joint
