"""Law `feedforward`: joint commands with which the joint PID gives the torque that a motion needs.

The drives need not accept torques. While a command U acts, the torque of a drive (eq. 31) is

    lp (U - theta) + ld (c U_dot - theta_dot) + li z - lx theta,    z_dot = U - theta

with c and lx as in `closed_loop.drives`. The filter of the law `pid_filtered` is ignored. Along the
desired motion, everything except U is known, and each command follows from the previous one. With
the zero hold, the mean torque of the drive while a command acts is equal to the mean torque of the
inverse dynamics. With the linear hold, the torque at the end of the ramp is equal to this mean, if
the joint moves with its mean velocity. The servo adds its correction.

Before the motion, the robot is in equilibrium. With an integral, z provides the torque of the model
at rest, and only changes of the modelled torque since then matter: a constant error of it has no
effect. Without an integral, the command provides the torque at rest.
"""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.drives import PID, Drives
from dynamics.closed_loop.loop_settings import EveryFrame, FrameTiming
from dynamics.control.inverse_dynamics import Model, Motion, spans
from dynamics.control.law_interface import Assignment, LawInLoop
from dynamics.control.observer import Estimate


def joint_commands(
    model: Model, motion: Motion, timing: FrameTiming, frames: int, drives: Drives = PID
) -> np.ndarray:
    """Commands (frames, n), rad or m, for a motion that starts from rest at time 0.

    Each command acts from its arrival, after the latency, to the arrival of the next command.
    Raises the same errors as `Robot.inverse_dynamics` if the motion leaves the reach.
    """
    period = 1 / timing.frame_rate_hz
    along = spans(model, motion, np.arange(frames) * period + timing.latency_s, period)
    law = drives.joint_law(model.gains)
    lp = law.lp
    li = law.li
    ld = law.ld
    c = law.rate_weight
    stiffness = law.lp + law.lx
    last_command, integral = model.held(motion.pose(np.zeros(1))[0], drives)
    commands = np.empty_like(along.mean)
    constant = timing.hold == "zero"
    for k in range(frames):
        moved = along.end[k] - along.begin[k]
        mean = along.mean[k]
        by_before = ld * (c * last_command + moved) / period
        # The torque of the drive, solved for the command: the mean torque during a constant
        # command, or the torque at the end of a ramp.
        if constant:
            torque = (
                along.torque[k]
                + stiffness * mean
                + by_before
                - li * (integral - along.mean_integral[k])
            )
            commands[k] = torque / (lp + c * ld / period + li * period / 2)
            integral = integral + period * (commands[k] - mean)
        else:
            torque = (
                along.torque[k]
                + stiffness * along.end[k]
                + by_before
                - li * (integral + period * (last_command / 2 - mean))
            )
            commands[k] = torque / (lp + c * ld / period + li * period / 2)
            integral = integral + period * ((last_command + commands[k]) / 2 - mean)
        last_command = commands[k]
    return commands


def feedforward(assignment: Assignment) -> LawInLoop:
    """Law in which the servo corrects the commands of `joint_commands`.

    With an observer, a controller takes the place of the servo. It corrects the pose predicted for
    the arrival of its command, and raises SimulationError if the observer diverges. The law itself
    raises the same errors as `joint_commands`.
    """
    settings = assignment.settings
    model = assignment.model
    drives = replace(settings.drives, torques=False)
    commands = joint_commands(model, assignment.motion, settings.timing, assignment.frames, drives)
    if not assignment.feedback.observer:
        return LawInLoop(feedforward=commands, drives=drives)
    observer = assignment.watched(drives)
    gains = settings.servo
    chart = model.robot.geometry.chart
    expected: list[Estimate] = []
    integral = np.zeros(len(chart.freedoms))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal integral
        expected.append(observer.see(frame, measured))
        arrival = observer.arrival(frame)
        predicted = observer.ahead(arrival)
        pose, rate, _ = assignment.desired(arrival)
        error = chart.coordinates(pose) - predicted.coordinates
        integral = integral + assignment.period * error
        demand = gains.demand(error, chart.coordinates(rate) - predicted.rates, integral)
        jacobian = model.robot.coordinate_jacobian(chart.pose(predicted.coordinates))
        issued = np.asarray(commands[frame] + jacobian @ demand)
        observer.issue(frame, issued)
        return issued

    return LawInLoop(
        controller=EveryFrame(command), drives=drives, expected=expected, by_servo=True
    )
