"""Kernels for the equation of motion at a state.

Each joint slips in one direction (mode +1 or -1) or sticks (mode 0). A stuck joint has the friction
torque that makes its acceleration zero. A joint at rest sticks if this torque is below its
breakaway torque. For friction and elastic joints see `joints`. The arguments `task`, `now`, `at`
and `d` are explained in `run_memory`.
"""

import numpy as np

from dynamics.closed_loop.drive_kernels import drive, winds_up
from dynamics.closed_loop.linear_algebra_kernels import copy, dot, factorise, fill, solve
from dynamics.compiled.kernel import Array, Record, call, entry, invoke, kernel

# indices of the friction laws in `joints.LawName`
SMOOTHED = 1
STRIBECK = 2
# status of a kernel; a run ends early with any other than OK
OK, LEFT_REACH, SINGULAR_MASS, TOO_MANY_EVENTS, MEASURED_OUT_OF_REACH = range(5)


@kernel
def dry_level(friction: Record, velocity: float, mode: int) -> float:
    """Ratio of slipping dry friction to Coulomb torque, at a velocity in rad/s or m/s."""
    if friction.law == SMOOTHED:
        return np.tanh(velocity / friction.smoothing_velocity)
    if friction.law == STRIBECK:
        ratio = velocity / friction.stribeck_velocity
        return mode * (1 + (friction.static_level - 1) * np.exp(-ratio * ratio))
    return mode * 1.0


@kernel
def dry_slope(friction: Record, velocity: float, mode: int) -> float:
    """Derivative of `dry_level` with respect to the velocity, s/rad or s/m."""
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
    """Return True if a joint can stick."""
    return task.friction.law != SMOOTHED and task.coulomb[joint] > 0


@kernel
def breakaway(task: Record, joint: int) -> float:
    """Largest friction torque of a joint at rest, N m or N."""
    return task.friction.static_level * task.coulomb[joint]


@kernel
def slip_friction(task: Record, joint: int, velocity: float, mode: int) -> float:
    """Friction torque of a joint that slips in the direction `mode`, N m or N."""
    return (
        task.coulomb[joint] * dry_level(task.friction, velocity, mode)
        + task.viscous[joint] * velocity
    )


@kernel
def count_stuck(now: Record) -> int:
    """Count the joints that stick, and list them at the beginning of `now.stuck`."""
    count = 0
    for i in range(len(now.mode)):
        if now.mode[i] == 0:
            now.stuck[count] = i
            count += 1
    return count


@kernel
def all_finite(matrix: Array) -> bool:
    """Return True if no entry is infinite or NaN."""
    finite = True
    for row in matrix:
        for value in row:
            finite = finite and bool(np.isfinite(value))
    return finite


@kernel
def know_motion(task: Record, known: Record, state: Array) -> int:
    """Compute the equation of motion at a state, unless `known` already has its terms there.

    `known` often has them, because consecutive steps and frames share a state.
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
    # entries are NaN at a pose out of reach; if all are finite, masses or inertias are wrong
    return SINGULAR_MASS if all_finite(known.mass) else LEFT_REACH


@entry
def evaluate_terms(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Compute the terms of an evaluation that do not depend on the modes, at its state and time.

    `d` and `k` are not used: all kernels that are called by address have the same arguments.
    """
    status = know_motion(task, now.known, at.state[:])
    if status == OK:
        take_known(now.known, at)
        drive(task, now, at)
    return status


@kernel
def take_known(known: Record, at: Record) -> None:
    """Copy the known terms of the equation of motion into an evaluation."""
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
    """Compute the response of the platform and of some joints to torques at these joints.

    The response M^-1 J^T of the platform has a row (m,) for each joint. Its first `known` rows have
    already been computed. The compliance J M^-1 J^T of the joints is factorised.
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
    """Compute the net torques in the present modes, without those that hold stuck rigid joints.

    The slope is the time derivative of the state. All its entries are set, except for the
    acceleration of the platform.
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
        at.slope[2 * size + i] = task.lx[i] * at.velocity[i] / task.li[i] if held else at.error[i]
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
            excess = at.net_torque[i] - at.spring[i]
            at.slope[motors + count + i] = excess / task.motor_inertia if now.mode[i] != 0 else 0.0
            # a stuck motor does not turn, because its friction balances the remaining torque
            if now.mode[i] == 0:
                at.stick_force[i] = excess
                at.net_torque[i] -= excess


@kernel
def hold_stuck(task: Record, now: Record, at: Record, known: int) -> None:
    """Compute the friction torques that keep stuck rigid joints at rest.

    Before the call, the slope has the acceleration without these torques. For `known` see
    `hold_compliance`.
    """
    size = len(at.bias)
    stuck = now.stuck[: count_stuck(now)]
    if task.stiffness > 0 or len(stuck) == 0:
        return
    acceleration = at.slope[size : 2 * size]
    hold_compliance(task, at, stuck, known)
    # together, the torques of all stuck joints make the accelerations of these joints zero
    for s in range(len(stuck)):
        at.force[s] = dot(at.jacobian[stuck[s]], acceleration) + at.bias_acceleration[stuck[s]]
    solve(at.stuck_factor, len(stuck), at.force)
    for s in range(len(stuck)):
        at.stick_force[stuck[s]] = at.force[s]
        at.net_torque[stuck[s]] -= at.force[s]
        for j in range(size):
            acceleration[j] -= at.response[s, j] * at.force[s]
    if len(stuck) == size:
        # no joint moves: without this line, rounding errors would move the robot slowly
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
    """Compute all terms at the state and time of an evaluation, in the present modes."""
    status = invoke(task.evaluate_terms, task, now, at, d, 0)
    if status == OK:
        accelerate(task, now, at)
    return status


@kernel
def follow_frictionless(task: Record, now: Record, at: Record) -> bool:
    """Set the modes of joints without dry friction to their directions of motion.

    Returns True if one of these joints has reversed.
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
    """Return True if no stuck joint has reached its breakaway torque."""
    holds = True
    for i in range(len(now.mode)):
        holds = holds and (now.mode[i] != 0 or abs(at.stick_force[i]) < breakaway(task, i))
    return holds


@entry
def decide_modes(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Decide which of the joints at rest (mode 0) stick, and in which direction the others start.

    Projected Gauss-Seidel iterations give the friction torques of rigid joints.
    """
    joints = now.stuck[: count_stuck(now)]
    # the motors of elastic joints are not coupled, so each mode is decided by itself
    if task.stiffness > 0:
        for i in joints:
            remaining = at.torque[i] - at.spring[i]
            now.mode[i] = 0 if abs(remaining) < breakaway(task, i) else 1 if remaining >= 0 else -1
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
            acceleration = dot(at.jacobian[joints[s]], free) + at.bias_acceleration[joints[s]]
            for r in range(len(joints)):
                acceleration -= at.compliance[s, r] * at.force[r]
            # each joint gets the friction torque that would stop it, up to its limit
            limit = breakaway(task, joints[s])
            force = min(max(at.force[s] + acceleration / at.compliance[s, s], -limit), limit)
            change = max(change, abs(force - at.force[s]))
            at.force[s] = force
        if change < 1e-15:
            break
    for s in range(len(joints)):
        sticks = abs(at.force[s]) < breakaway(task, joints[s])
        now.mode[joints[s]] = 0 if sticks else 1 if at.force[s] >= 0 else -1
    return OK


@kernel
def mode_margin(task: Record, now: Record, at: Record) -> tuple[float, int]:
    """Return the least margin of the modes, at most 1, and the joint that has it.

    A margin is a speed, rad/s or m/s, or the unused fraction of a breakaway torque. The least
    margin is >= 0 as long as all modes hold. The joint is -1 if no margin is less than 1.
    """
    least = 1.0
    joint = -1
    for i in range(len(now.mode)):
        if not has_events(task, i):
            continue
        margin = now.mode[i] * at.velocity[i]
        if now.mode[i] == 0:
            # relative to the breakaway torque, so that joints can be compared
            margin = 1 - abs(at.stick_force[i]) / breakaway(task, i)
        if margin < least:
            least = margin
            joint = i
    return least, joint
