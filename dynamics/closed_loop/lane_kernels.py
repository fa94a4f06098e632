"""Kernels for several runs of one model at once, each in one lane of the vector registers.

Every run has its own measurements, modes, events and steps. The equation of motion takes most of
the time, and is computed for all lanes together.
"""

import numpy as np

from dynamics.closed_loop.drive_kernels import drive
from dynamics.closed_loop.frame_kernels import begin, next_span
from dynamics.closed_loop.linear_algebra_kernels import copy
from dynamics.closed_loop.motion_kernels import OK, count_stuck, hold_stuck, push
from dynamics.closed_loop.sensitivity_kernels import END
from dynamics.closed_loop.stick_slip_kernels import (
    BRACKET,
    TAKEN,
    begin_step,
    judge,
    next_step,
    set_stage,
)
from dynamics.compiled.kernel import Array, Record, call_columns, entry, invoke, kernel
from dynamics.parameters import LANES


@kernel
def evaluate_lanes(
    task: Record, now: Record, at: Record, d: Record, lanes: Record, asked: Array, k: int
) -> None:
    """Do the same as `evaluate` at stage `k`, for the lanes in `asked` whose status is OK.

    The slope is always stored. The terms of the equation of motion are stored only if they will be
    read again: if several joints stick, or at the end of a step with a stuck joint or an event.
    """
    size = len(at[0, 0].bias)
    count = len(at[0, 0].angle)
    for lane in asked:
        for j in range(2 * size):
            lanes.states[j, lane] = at[lane, k].state[j]
    call_columns(task.motion_in_lanes, lanes.shared, lanes.states, lanes.bias_acceleration, LANES)
    for lane in asked:
        own = now[lane]
        stage = at[lane, k]
        if own.status != OK:
            continue
        stuck = count_stuck(own)
        if task.stiffness == 0 and (
            stuck > 1 or (k == END and (stuck > 0 or own.purpose >= BRACKET))
        ):
            take_lane(lanes, lane, stage)
        for i in range(count):
            stage.angle[i] = lanes.angle[i, lane]
            stage.velocity[i] = lanes.velocity[i, lane]
        drive(task, own, stage)
        push(task, own, stage)
        for i in range(count):
            lanes.push[i, lane] = stage.spring[i] if task.stiffness > 0 else stage.net_torque[i]
        if stuck > 0:
            joint = own.stuck[0]
            stage.bias_acceleration[joint] = lanes.bias_acceleration[joint, lane]
            for j in range(size):
                stage.jacobian[joint, j] = lanes.row[j, lane] = lanes.jacobian[joint, j, lane]
    call_columns(task.acceleration_in_lanes, lanes.shared, lanes.factor, lanes.acceleration, LANES)
    for lane in asked:
        own = now[lane]
        stage = at[lane, k]
        if own.status != OK:
            continue
        if has_factor(lanes, lane):
            for j in range(size):
                stage.slope[size + j] = lanes.acceleration[j, lane]
                stage.response[0, j] = lanes.response[j, lane]
            hold_stuck(task, own, stage, 1)
        else:
            own.known.valid = False
            # the kernel for a single run finds out why the evaluation failed
            own.status = invoke(task.evaluate, task, own, stage, d, 0)


@kernel
def has_factor(lanes: Record, lane: int) -> bool:
    """Return True if the mass matrix of a lane is positive definite and finite."""
    valid = True
    for i in range(lanes.factor.shape[0]):
        valid = valid and 0 < lanes.factor[i, i, lane] < np.inf
    return valid


@kernel
def take_lane(lanes: Record, lane: int, into: Record) -> None:
    """Copy the terms of the equation of motion of one lane."""
    count, size = into.jacobian.shape
    for i in range(size):
        into.bias[i] = lanes.bias[i, lane]
        for j in range(size):
            into.factor[i, j] = lanes.factor[i, j, lane]
    for i in range(count):
        into.bias_acceleration[i] = lanes.bias_acceleration[i, lane]
        into.angle[i] = lanes.angle[i, lane]
        into.velocity[i] = lanes.velocity[i, lane]
        for j in range(size):
            into.jacobian[i, j] = lanes.jacobian[i, j, lane]


@kernel
def know_lane(now: Record, at: Record, lanes: Record, lane: int) -> None:
    """Store the terms at the end of a span, because the next span begins with them."""
    known = now.known
    size = len(at.bias)
    copy(at.state[: 2 * size], known.inputs[: 2 * size])
    take_lane(lanes, lane, known)
    known.valid = True


@kernel
def try_steps(
    task: Record, now: Record, at: Record, d: Record, lanes: Record, asked: Array
) -> None:
    """Do the steps that the lanes in `asked` request."""
    for lane in asked:
        now[lane].status = begin_step(task, now[lane], at[lane], d)
    for k in range(1, END + 1):
        for lane in asked:
            set_stage(now[lane], at[lane], k)
        evaluate_lanes(task, now, at, d, lanes, asked, k)


@entry
def run_lanes(
    task: Record, now: Record, at: Record, d: Record, plan: Record, record: Record, lanes: Record
) -> None:
    """Run all frames of several runs, one in each lane.

    In `record`, and in the noise of `plan`, the rows of the runs follow one after the other. Each
    run has its own status and frame. A run whose status is not OK has ended early.
    """
    frames = len(plan.spans.first) - 1
    asked = lanes.asked
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
            own = now[lane]
            if own.status == OK:
                own.status = judge(task, own, at[lane], d)
            if own.purpose == TAKEN and own.grid == own.steps and not own.moved:
                know_lane(own, at[lane, 0], lanes, lane)
