"""Several runs of one model at once, which differ in what they measure: a lane each.

Every run goes its own way, with modes, events and steps of its own. What they have in common is that all of them ask
for the equation of motion, time and again: that is computed for all lanes together.
"""

import numpy as np

from dynamics.closed_loop.frame_kernels import begin, next_span
from dynamics.closed_loop.linear_algebra_kernels import copy
from dynamics.closed_loop.motion_kernels import OK
from dynamics.closed_loop.sensitivity_kernels import END
from dynamics.closed_loop.stick_slip_kernels import judge, next_step, set_stage
from dynamics.compiled.kernel import Array, Record, call_columns, entry, invoke, kernel


@kernel
def know_motions(task: Record, now: Record, at: Record, lanes: Record, asked: Array, k: int) -> None:
    """The equation of motion at stage `k` of the lanes that ask for it."""
    size = len(at[0, 0].bias)
    for lane in asked:
        for j in range(2 * size):
            lanes.states[j, lane] = at[lane, k].state[j]
    call_columns(task.motion_in_lanes, lanes.shared, lanes.states, lanes.factor, lanes.states.shape[1])
    for lane in asked:
        known = now[lane].known
        copy(at[lane, k].state[: 2 * size], known.inputs[: 2 * size])
        take_lane(lanes, lane, known)


@kernel
def take_lane(lanes: Record, lane: int, known: Record) -> None:
    """What is known of one lane. Where it has no factor it counts as unknown, and is asked for again alone."""
    count, size = known.jacobian.shape
    known.valid = True
    for i in range(size):
        known.bias[i] = lanes.bias[i, lane]
        for j in range(size):
            known.factor[i, j] = lanes.factor[i, j, lane]
        known.valid = known.valid and 0 < known.factor[i, i] < np.inf
    for i in range(count):
        known.bias_acceleration[i] = lanes.bias_acceleration[i, lane]
        known.angle[i], known.velocity[i] = lanes.angle[i, lane], lanes.velocity[i, lane]
        for j in range(size):
            known.jacobian[i, j] = lanes.jacobian[i, j, lane]


@kernel
def try_steps(task: Record, now: Record, at: Record, d: Record, lanes: Record, asked: Array) -> None:
    """The steps that lanes ask for; the status of each."""
    for k in range(1, END + 1):
        for lane in asked:
            set_stage(now[lane], at[lane], k)
        know_motions(task, now, at, lanes, asked, k)
        for lane in asked:
            if now[lane].status == OK:
                now[lane].status = invoke(task.evaluate, task, now[lane], at[lane, k], d, 0)


@entry
def run_lanes(task: Record, now: Record, at: Record, d: Record, plan: Record, record: Record, lanes: Record) -> None:
    """All frames of the runs `now` (one a lane), whose rows in plan and record follow each other; the status of each
    and its frame."""
    frames, asked = len(plan.spans.first) - 1, lanes.asked
    for lane in range(len(now)):
        begin(task, now[lane], at[lane], d, plan)
    count = 1
    while count > 0:
        count = 0
        for lane in range(len(now)):
            own = now[lane]
            while own.status == OK and own.frame < frames and not next_step(own, at[lane]):
                own.status = next_span(task, own, at[lane], d, plan, record)
            if own.status == OK and own.frame < frames:
                asked[count] = lane
                count += 1
        try_steps(task, now, at, d, lanes, asked[:count])
        for lane in asked[:count]:
            if now[lane].status == OK:
                now[lane].status = judge(task, now[lane], at[lane], d)
