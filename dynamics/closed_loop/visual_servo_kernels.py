"""Visual servo (eq. 30), and its derivatives.

The joint command is U = J_theta [kp e + kd e_dot + ki integral(e)]. J_theta is the Jacobian of the
joints, and e is the desired minus the measured pose of the frame. The measured pose rate is the
difference of the newest two measurements divided by the time between them. The start state has the
measurement before the first frame. The integral is the sum of the errors, up to this frame, times
the frame period. At a lost frame the servo does not run: its last measurement, integral and command
stay as they are. The feedforward is added at every frame. Model-based laws predict the pose at a
lost frame (`dynamics.control.observer`).
"""

import numpy as np

from dynamics.closed_loop.drive_kernels import scale_received
from dynamics.closed_loop.linear_algebra_kernels import (
    add,
    add_product,
    clear,
    copy,
    copy_rows,
    dot,
    fill,
)
from dynamics.closed_loop.motion_kernels import MEASURED_OUT_OF_REACH, OK, all_finite
from dynamics.closed_loop.sensitivity_kernels import velocity_by_pose
from dynamics.compiled.kernel import Array, Record, call, kernel


@kernel
def issue_command(
    task: Record, now: Record, d: Record, plan: Record, record: Record, k: int
) -> int:
    """Measure the pose, unless Python has done so, and record the command that is issued.

    Returns MEASURED_OUT_OF_REACH if the command is not finite.
    """
    if not task.measured:
        measure_ideally(now, plan, record, k)
    now.elapsed += task.period
    row = now.first_row + k
    if len(plan.commands) > 0:
        copy(plan.commands[k], now.last_command[:])
    elif record.measured_ok[row]:  # at a lost frame, `last_command` stays as it is
        serve(task, now, d, plan, record.measured[row], k)
    copy(now.last_command[:], record.command[row])
    if len(plan.feedforward) > 0:
        add(plan.feedforward[k], record.command[row])
    if task.sensitivities:
        issued = d.issued[k % (len(d.issued) - 1)]
        copy_rows(d.last_command[:], issued, now.width)
        if len(plan.directions) > 0:
            for i in range(len(now.mode)):
                for j in range(plan.directions.shape[2]):
                    issued[i, now.parameters + j] += plan.directions[k, i, j]
        scale_received(task, record.command[row], issued, now.width)
    return OK if all_finite(record.command[row : row + 1]) else MEASURED_OUT_OF_REACH


@kernel
def measure_ideally(now: Record, plan: Record, record: Record, k: int) -> None:
    """Measure the pose of a frame as the ideal sensor does."""
    row = now.first_row + k
    seen = len(plan.lost) == 0 or not plan.lost[k]
    measured = record.measured[row]
    record.measured_ok[row] = seen
    copy(now.state[: len(measured)], measured)
    if not seen:
        fill(measured, np.nan)
    if len(plan.noise) > 0:
        add(plan.noise[row], measured)


@kernel
def serve(task: Record, now: Record, d: Record, plan: Record, measured: Array, k: int) -> None:
    """Compute the command of the servo at a measured frame, and its derivatives.

    The servo needs the Jacobian at the measured pose. If the measured pose is the true pose, and
    the servo uses the true geometry, the Jacobian of the motion is used, which is already known.
    """
    size = len(measured)
    known = now.known
    same = known.valid and task.servo_knows
    reference = plan.reference[k]
    reference_rate = plan.reference_rate[k]
    for i in range(size):
        error = reference[i] - measured[i]
        # the rate is over the time since the last good measurement, which may be several frames
        rate = (measured[i] - now.last_measured[i]) / now.elapsed
        now.servo_integral[i] += task.period * error
        by_rate = task.kd * (reference_rate[i] - rate)
        now.demand[i] = task.kp * error + by_rate + task.ki * now.servo_integral[i]
        same = same and known.inputs[i] == measured[i]
    jacobian = known.jacobian if same else now.served.jacobian
    if not same:
        copy(measured, now.served.inputs[:size])
        call(task.servo_jacobian, now.served.inputs, now.served.jacobian)
    for i in range(len(now.mode)):
        now.last_command[i] = dot(jacobian[i], now.demand[:])
    if task.sensitivities:
        serve_tangent(task, now, d, measured, jacobian)
    copy(measured, now.last_measured[:])
    now.elapsed = 0.0


@kernel
def serve_tangent(task: Record, now: Record, d: Record, measured: Array, jacobian: Array) -> None:
    """Differentiate the command of the servo. The derivatives of the measured pose are in `d.x`."""
    width = now.width
    velocity_by_pose(task, now, measured, now.demand[:])
    for i in range(len(now.demand)):
        for k in range(width):
            moved = d.x[i, k]
            d_rate = (moved - d.last_measured[i, k]) / now.elapsed
            d.integral[i, k] -= task.period * moved
            d.demand[i, k] = -task.kp * moved - task.kd * d_rate + task.ki * d.integral[i, k]
            d.last_measured[i, k] = moved
    clear(d.last_command[:], width)
    add_product(1.0, jacobian, d.demand[:], d.last_command[:], width)
    add_product(1.0, now.rate_map, d.last_measured[:], d.last_command[:], width)
