"""Kernels for motion with dry joint friction over a span of time with one command.

The mode of a joint is stuck, or slipping in one direction. Between changes of the modes the motion
is smooth, and the classical Runge-Kutta method integrates it. A mode ends when a slipping joint
comes to rest, or when a stuck joint reaches its breakaway torque (eq. 24). The step is shortened to
end at this event, up to rounding errors. The margin of a mode is positive as long as the mode
holds: it is the speed of a slipping joint, or the unused fraction of the breakaway torque. The
arguments `task`, `now`, `at` and `d` are explained in `run_memory`.
"""

from dynamics.closed_loop.linear_algebra_kernels import clear, copy, dot, fill, solve
from dynamics.closed_loop.motion_kernels import (
    OK,
    TOO_MANY_EVENTS,
    accelerate,
    all_hold,
    count_stuck,
    follow_frictionless,
    hold_compliance,
    mode_margin,
)
from dynamics.closed_loop.sensitivity_kernels import (
    END,
    FRACTION,
    WEIGHT,
    rest_tangent,
    step_tangent,
)
from dynamics.compiled.kernel import Record, entry, invoke, kernel

MAX_EVENTS_PER_SPAN = 400  # a run with more events in one span ends early
# a margin up to this counts as zero; it is in rad/s or m/s, or a fraction of the breakaway torque
NO_MARGIN = 1e-12
# margin of a stuck joint, as a fraction of the breakaway torque, up to which it is rounding error
TORQUE_ROUNDING = 1e-13


# Purposes of the step that is being tried. TAKEN: the last step was accepted, and no step is being
# tried. WHOLE: a step to the target time. HALF: half the step, to see whether modes are broken in
# between. AGAIN: the whole step again, after half of it broke no mode. BRACKET: a step in search of
# the beginning of the bracket of an event. CROSSING: a step that ends at the estimated event.
TAKEN, WHOLE, HALF, AGAIN, BRACKET, CROSSING = range(6)


@kernel
def ask(now: Record, purpose: int, length: float) -> None:
    """Request a step of a length, s."""
    now.purpose = purpose
    now.length = length


@kernel
def set_stage(now: Record, at: Record, k: int) -> None:
    """Set the state and time of stage `k` of the step that is being tried, or of its end."""
    start = at[0]
    stage = at[k]
    h = now.length
    if k < END:
        # Classical Runge-Kutta: a stage needs only the slope of the stage before it.
        before = at[k - 1]
        for i in range(now.unknowns):
            stage.state[i] = start.state[i] + FRACTION[k] * h * before.slope[i]
        stage.time = start.time + FRACTION[k] * h
        return
    for i in range(now.unknowns):
        reached = start.state[i]
        for stage_before in range(END):
            reached += WEIGHT[stage_before] * h * at[stage_before].slope[i]
        stage.state[i] = reached
    stage.time = start.time + h


@kernel
def begin_step(task: Record, now: Record, at: Record, d: Record) -> int:
    """Evaluate the state at the beginning of a step, unless the previous step has done so."""
    if not now.moved:
        return OK
    now.moved = 0
    return invoke(task.evaluate, task, now, at[0], d, 0)


@kernel
def try_step(task: Record, now: Record, at: Record, d: Record) -> int:
    """Do the requested Runge-Kutta step with fixed modes.

    It begins at the evaluation `at[0]` and computes the stages and the end of the step.
    """
    status = begin_step(task, now, at, d)
    if status != OK:
        return status
    for k in range(1, END + 1):
        set_stage(now, at, k)
        status = invoke(task.evaluate, task, now, at[k], d, 0)
        if status != OK:
            return status
    return OK


@kernel
def crossing(now: Record, count: int) -> float:
    """Step length at which the margin is estimated to be zero.

    A polynomial gives the length as a function of the margin. It passes through the last `count`
    steps tried, and its value at zero is the estimate.
    """
    length = now.tried
    margin = now.tried_margin
    estimate = now.tried_crossing
    for i in range(count):
        estimate[i] = length[i]
    # Neville's scheme evaluates the polynomial at a margin of zero.
    for order in range(1, count):
        for i in range(count - order):
            span = margin[i] - margin[i + order]
            estimate[i] = (margin[i] * estimate[i + 1] - margin[i + order] * estimate[i]) / span
    return estimate[0]


@kernel
def remember(now: Record, h: float, margin: float) -> None:
    """Store a step that was tried, with the margin at its end, as the most recent one."""
    for i in range(len(now.tried) - 1, 0, -1):
        now.tried[i] = now.tried[i - 1]
        now.tried_margin[i] = now.tried_margin[i - 1]
    now.tried[0] = h
    now.tried_margin[0] = margin


@kernel
def locate_event(task: Record, now: Record, at: Record, d: Record, margin: float) -> int:
    """Begin the search for the step length at which a mode ceases to hold.

    At this length, the margin crosses zero. The search begins with the bracket from zero to the
    length of the step just tried, which ends with `margin`. It uses inverse interpolation, and
    halves the bracket if the interpolation leaves it. The first guess uses the stage at half the
    step. For a joint that has just started from rest, the margin is zero at the beginning of the
    step, too. Halving then gives the beginning of the bracket.
    """
    now.events_left -= 1
    if now.events_left < 0:
        return TOO_MANY_EVENTS
    now.cut = now.length
    now.low = 0.0
    now.high = now.length
    now.trials = 0
    now.low_margin = mode_margin(task, now, at[0])[0]
    now.high_margin = margin
    now.half_margin = mode_margin(task, now, at[2])[0]
    return narrow(task, now, at, d)


@kernel
def narrow(task: Record, now: Record, at: Record, d: Record) -> int:
    """Request the next step of the search for an event.

    The bracket is halved until the margin at its beginning is positive. If 40 halvings have found
    no such bracket, the step just tried is accepted.
    """
    if now.low_margin < NO_MARGIN and now.trials < 40:
        ask(now, BRACKET, now.high / 2)
        return OK
    if now.low_margin <= 0:
        return take_step(task, now, at, d, True, False)
    remember(now, now.cut / 2, now.half_margin)
    remember(now, now.low, now.low_margin)
    remember(now, now.high, now.high_margin)
    now.trials = 3
    ask_between(now, crossing(now, 3 if now.high - now.low == now.cut else 2))
    return OK


@kernel
def ask_between(now: Record, length: float) -> None:
    """Request a step to the estimated event.

    If the estimate is outside the bracket, or after 41 estimates, the step goes to the middle. (The
    first estimate is trial 3.)
    """
    if now.trials > 43 or not now.low < length < now.high:
        length = 0.5 * (now.low + now.high)
    ask(now, CROSSING, length)


@kernel
def judge_bracket(task: Record, now: Record, at: Record, d: Record, margin: float) -> int:
    """Replace an end of the bracket by the step tried. Its length is half of `now.high`."""
    now.trials += 1
    if margin > 0:
        now.low = now.length
        now.low_margin = margin
        now.trials = 40
    else:
        now.high = now.length
        now.high_margin = margin
    return narrow(task, now, at, d)


@kernel
def judge_crossing(task: Record, now: Record, at: Record, d: Record, margin: float) -> int:
    """Accept a step to the estimated event, or request another one with a better estimate.

    A step is accepted if its margin or the error of its length is negligible, or if it is the 80th.
    """
    tried = now.length
    if margin > 0:
        now.low = tried
    else:
        now.high = tried
    remember(now, tried, margin)
    better = crossing(now, min(now.trials, len(now.tried)))
    stuck = now.mode[mode_margin(task, now, at[END])[1]] == 0
    negligible = TORQUE_ROUNDING if stuck else 0.0
    # because of rounding, a bracket cannot become shorter than this
    near = min(abs(better - tried), now.high - now.low) <= 1e-15 + 1e-13 * now.cut
    now.trials += 1
    if abs(margin) <= negligible or near or now.trials == 83:
        return take_step(task, now, at, d, True, True)
    ask_between(now, better)
    return OK


@kernel
def judge(task: Record, now: Record, at: Record, d: Record) -> int:
    """Decide what follows the step that was tried: it is accepted, or another step is requested.

    Modes that hold at both ends of a step may be broken in between, if a joint reverses twice. The
    stages can indicate this, and a step of half the length then checks it.
    """
    margin = mode_margin(task, now, at[END])[0]
    if now.purpose == BRACKET:
        return judge_bracket(task, now, at, d, margin)
    if now.purpose == CROSSING:
        return judge_crossing(task, now, at, d, margin)
    if now.purpose != AGAIN and margin < 0:
        return locate_event(task, now, at, d, margin)
    # the modes have held for half the step, so that the whole step can be accepted
    if now.purpose == HALF:
        ask(now, AGAIN, 2 * now.length)
    elif now.purpose == AGAIN or (
        mode_margin(task, now, at[1])[0] >= 0 and mode_margin(task, now, at[2])[0] >= 0
    ):
        return take_step(task, now, at, d, False, True)
    else:
        ask(now, HALF, now.length / 2)
    return OK


@entry
def stop_joints(task: Record, now: Record, at: Record, d: Record, k: int) -> int:
    """Remove the velocities of stuck joints from the state, as an impulse would.

    The compliance of rigid joints must have been computed.
    """
    size = len(at.bias)
    stuck = now.stuck[: count_stuck(now)]
    rate = now.state[size : 2 * size]
    if task.stiffness > 0:
        # elastic joints are stopped one by one, because their motors are not coupled
        for i in stuck:
            now.state[2 * size + 2 * len(now.mode) + i] = 0.0
        return OK
    if len(stuck) == 0:
        return OK
    # if as many joints stick as there are coordinates, nothing may move, not even by rounding
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
def after_event(task: Record, now: Record, at: Record, d: Record, held: bool) -> int:
    """Change the modes after an event.

    `held` is False for a joint that starts from rest, turns back at once, and sticks.
    """
    end = at[END]
    joint = mode_margin(task, now, end)[1]
    # a stuck joint breaks away in the direction of the torque that its friction balanced
    if now.mode[joint] == 0:
        now.mode[joint] = 1 if end.stick_force[joint] > 0 else -1
        return OK
    now.mode[joint] = 0
    if task.stiffness == 0:
        hold_compliance(task, end, now.stuck[: count_stuck(now)], 0)
    invoke(task.stop_joints, task, now, end, d, 0)
    copy(now.state[:], end.state[:])
    status = invoke(task.evaluate_terms, task, now, end, d, 0)
    # the impulse that stops a joint can break other joints away: the modes are decided again
    if status == OK and held:
        invoke(task.decide_modes, task, now, end, d, 0)
    return status


@kernel
def take_step(task: Record, now: Record, at: Record, d: Record, event: bool, held: bool) -> int:
    """Accept the step that was tried, which ends at the target time or at an event.

    For `held` see `after_event`.
    """
    time = now.target
    now.purpose = TAKEN
    if task.sensitivities:
        step_tangent(task, now, at, d, now.length, event, event and held)
    copy(at[END].state[:], now.state[:])
    if event:
        now.events += 1
        time = at[END].time
        status = after_event(task, now, at, d, held)
        if status != OK:
            return status
    else:
        invoke(task.stop_joints, task, now, at[END], d, 0)
        same_modes = not follow_frictionless(task, now, at[END])
        if same_modes and count_stuck(now) == 0:
            # the end of this step is the start of the next, which need not be evaluated again
            at[0] = at[END]
            at[0].time = time
            return OK
    copy(now.state[:], at[0].state[:])
    at[0].time = time
    now.moved = 1
    return OK


@kernel
def begin_span(
    task: Record, now: Record, at: Record, d: Record, duration: float, steps: int
) -> None:
    """Begin a span with one command, whose torques have been computed. `duration` is in s.

    Torques jump at the start of a span. The modes are therefore decided again, unless the friction
    of all stuck joints still holds them.
    """
    start = at[0]
    now.moved = 0
    follow_frictionless(task, now, start)
    accelerate(task, now, start)
    if not all_hold(task, now, start):
        invoke(task.decide_modes, task, now, start, d, 0)
        accelerate(task, now, start)
    if now.start_moves:
        rest_tangent(task, now, start, d)
    now.start_moves = 0
    now.events_left = MAX_EVENTS_PER_SPAN
    now.duration = duration
    now.steps = steps


@kernel
def next_step(now: Record, at: Record) -> bool:
    """Request the next step, unless a step is being tried. Return False at the end of the span."""
    if now.purpose != TAKEN:
        return True
    while at[0].time >= now.target:
        if now.grid == now.steps:
            return False
        now.grid += 1
        now.target = now.duration * now.grid / now.steps
    ask(now, WHOLE, now.target - at[0].time)
    return True
