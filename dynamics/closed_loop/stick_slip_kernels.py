"""Motion with dry joint friction over a span of constant command.

Between mode changes the motion is smooth and classical Runge-Kutta integrates it. A mode ends where a slipping joint
comes to rest or a stuck joint reaches its breakaway torque (eq. 24); the step is cut there, to rounding.
"""

from dynamics.closed_loop.linear_algebra_kernels import clear, copy, dot, fill, solve
from dynamics.closed_loop.motion_kernels import (
    OK,
    TOO_MANY_EVENTS,
    follow_frictionless,
    hold_compliance,
    mode_margin,
    stuck_joints,
)
from dynamics.closed_loop.sensitivity_kernels import END, FRACTION, WEIGHT, rest_tangent, step_tangent
from dynamics.compiled.kernel import Record, entry, invoke, kernel

MAX_EVENTS_PER_SEGMENT = 400
NO_MARGIN = 1e-12  # rad/s, or share of the breakaway torque
LITTLE_SHARE = 1e-13  # of the breakaway torque: as far as rounding lets it be known


@kernel
def try_step(task: Record, now: Record, at: Record, d: Record, h: float) -> tuple[int, float]:
    """A Runge-Kutta step of h s with fixed modes from the evaluation `at[0]`: its stages, its end, the margin there."""
    start, end = at[0], at[END]
    for k in range(1, 4):
        for i in range(len(now.state)):
            at[k].state[i] = start.state[i] + FRACTION[k] * h * at[k - 1].slope[i]
        at[k].time = start.time + FRACTION[k] * h
        status = invoke(task.evaluate, task, now, at[k], d, 0)
        if status != OK:
            return status, 0.0
    copy(start.state[:], end.state[:])
    for k in range(4):
        for i in range(len(now.state)):
            end.state[i] += WEIGHT[k] * h * at[k].slope[i]
    end.time = start.time + h
    status = invoke(task.evaluate, task, now, end, d, 0)
    return status, mode_margin(task, now, end)[0]


@kernel
def breaks_halfway(task: Record, now: Record, at: Record, d: Record, h: float) -> tuple[int, bool, float]:
    """Whether modes that hold at both ends of a step are broken in between (a joint reversing twice); and the margin.

    The stages give a hint, which a step of half the length confirms: that is then the step tried. After a false alarm
    it is the whole step again.
    """
    if mode_margin(task, now, at[1])[0] >= 0 and mode_margin(task, now, at[2])[0] >= 0:
        return OK, False, 0.0
    status, margin = try_step(task, now, at, d, h / 2)
    if status != OK or margin < 0:
        return status, True, margin
    status, margin = try_step(task, now, at, d, h)
    return status, False, margin


@kernel
def crossing(now: Record, count: int) -> float:
    """Where the last `count` steps that were tried would have no margin left: the polynomial of step over margin."""
    length, margin, found = now.tried, now.tried_margin, now.tried_crossing
    for i in range(count):
        found[i] = length[i]
    for order in range(1, count):
        for i in range(count - order):
            apart = margin[i] - margin[i + order]
            found[i] = (margin[i] * found[i + 1] - margin[i + order] * found[i]) / apart
    return found[0]


@kernel
def remember(now: Record, h: float, margin: float) -> None:
    """Put a step that was tried, and the margin at its end, before the ones before."""
    for i in range(len(now.tried) - 1, 0, -1):
        now.tried[i], now.tried_margin[i] = now.tried[i - 1], now.tried_margin[i - 1]
    now.tried[0], now.tried_margin[0] = h, margin


@kernel
def locate_event(task: Record, now: Record, at: Record, d: Record, h: float, margin: float) -> tuple[int, float, bool]:
    """The step in (0, h] at which the modes stop holding: the margin, here that at h, crosses zero. Found by inverse
    interpolation, and by halving the bracket where that leads out of it; the first time with what the stage at half the
    step says, which is near.

    A joint that has just started from rest has no margin yet: then the bracket is found by halving; the last entry
    returned is False where there is none.
    """
    low, high, halfway = 0.0, h, mode_margin(task, now, at[2])[0]
    at_low, at_high = mode_margin(task, now, at[0])[0], margin
    for _ in range(40):
        if at_low >= NO_MARGIN:
            break
        status, margin = try_step(task, now, at, d, high / 2)
        if status != OK:
            return status, high, False
        if margin > 0:
            low, at_low = high / 2, margin
            break
        high, at_high = high / 2, margin
    if at_low <= 0:
        return OK, high, False
    remember(now, h / 2, halfway)
    remember(now, low, at_low)
    remember(now, high, at_high)
    middle, tried = crossing(now, 3 if high - low == h else 2), high
    for count in range(3, 83):
        if count > 43 or not low < middle < high:
            middle = 0.5 * (low + high)
        status, margin = try_step(task, now, at, d, middle)
        if status != OK:
            return status, high, False
        if margin > 0:
            low = middle
        else:
            high = middle
        remember(now, middle, margin)
        tried, middle = middle, crossing(now, min(count, len(now.tried)))
        holds = now.mode[mode_margin(task, now, at[END])[1]] == 0
        little = LITTLE_SHARE if holds else 0.0
        if abs(margin) <= little or min(abs(middle - tried), high - low) <= 1e-15 + 1e-13 * h:
            break
    return OK, tried, True


@entry
def stop_joints(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Take the velocities of the stuck joints, whose compliance is known, out of the state, as an impulse would."""
    size, stuck = len(at.bias), stuck_joints(now)
    rate = now.state[size : 2 * size]
    if task.stiffness > 0:
        for i in stuck:
            now.state[2 * size + 2 * len(now.mode) + i] = 0.0
        return OK
    if len(stuck) == 0:
        return OK
    if len(stuck) == size:
        fill(rate, 0.0)
        clear(d.x[size : 2 * size], now.width)
        return OK
    for s in range(len(stuck)):
        at.force[s] = dot(at.jacobian[stuck[s]], rate)
    solve(at.stuck_factor, len(stuck), at.force)
    fill(now.change[:], 0.0)
    for s in range(len(stuck)):
        for j in range(size):
            now.change[j] -= at.response[s, j] * at.force[s]
    for j in range(size):
        rate[j] += now.change[j]
    if task.sensitivities:
        return invoke(task.stop_tangent, task, now, at, d, 0)
    return OK


@kernel
def evaluate_anew(task: Record, now: Record, at: Record, d: Record, time: float) -> int:
    """The evaluation at the state that the integrator has reached, from which the next step starts."""
    copy(now.state[:], at[0].state[:])
    at[0].time = time
    return invoke(task.evaluate, task, now, at[0], d, 0)


@kernel
def after_event(task: Record, now: Record, at: Record, d: Record, held: bool) -> int:
    """Change the modes; `held` is False where a joint that starts from rest turns back at once: it sticks."""
    end = at[END]
    joint = mode_margin(task, now, end)[1]
    if now.mode[joint] == 0:
        now.mode[joint] = 1 if end.stick_force[joint] > 0 else -1
        return OK
    now.mode[joint] = 0
    if task.stiffness == 0:
        hold_compliance(task, end, stuck_joints(now))
    invoke(task.stop_joints, task, now, end, d, 0)
    copy(now.state[:], end.state[:])
    status = invoke(task.evaluate_terms, task, now, end, d, 0)
    if status == OK and held:
        invoke(task.decide_modes, task, now, end, d, 0)
    return status


@kernel
def step(task: Record, now: Record, at: Record, d: Record, target: float) -> int:
    """One step to the time `target`, s, or to where the first mode before it ends."""
    h, held = target - at[0].time, True
    status, margin = try_step(task, now, at, d, h)
    if status != OK:
        return status
    event = margin < 0
    if not event:
        status, event, halfway = breaks_halfway(task, now, at, d, h)
        if status != OK:
            return status
        if event:
            h, margin = h / 2, halfway
    if event:
        now.events_left -= 1
        if now.events_left < 0:
            return TOO_MANY_EVENTS
        status, h, held = locate_event(task, now, at, d, h, margin)
        if status != OK:
            return status
        now.events += 1
    if task.sensitivities:
        step_tangent(task, now, at, d, h, event, event and held)
    copy(at[END].state[:], now.state[:])
    if event:
        target = at[END].time
        status = after_event(task, now, at, d, held)
        if status != OK:
            return status
    else:
        invoke(task.stop_joints, task, now, at[END], d, 0)
        follow_frictionless(task, now, at[END])
    return evaluate_anew(task, now, at, d, target)


@kernel
def segment(task: Record, now: Record, at: Record, d: Record, duration: float, steps: int) -> int:
    """Integrate over a time, s, with one command. Modes are decided anew at its start, where the torque jumps."""
    start = at[0]
    copy(now.state[:], start.state[:])
    start.time = 0.0
    status = invoke(task.evaluate_terms, task, now, start, d, 0)
    if status != OK:
        return status
    follow_frictionless(task, now, start)
    invoke(task.decide_modes, task, now, start, d, 0)
    status = evaluate_anew(task, now, at, d, 0.0)
    if status == OK and now.start_moves:
        rest_tangent(task, now, start, d)
    now.start_moves = 0
    now.events_left = MAX_EVENTS_PER_SEGMENT
    for n in range(1, steps + 1):
        target = duration * n / steps
        while status == OK and start.time < target:
            status = step(task, now, at, d, target)
    return status
