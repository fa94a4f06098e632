"""Law `feedforward`: joint commands so shaped that the torque of the joint PID is what the motion takes.

No access to torques is needed. While a command U acts, a drive (eq. 31) gives lp (U - theta) + ld (c U_dot - theta_dot)
+ li z - lx theta with z_dot = U - theta (`closed_loop.drives`). Along the desired motion everything but U is known, so
that each command follows from the one before: with commands that are held, the mean of the drive's torque over the
time for which a command acts is that of the inverse dynamics; with commands that ramp, the torque at the end of the
ramp. The servo's correction comes on top.

Before the motion the robot stands in equilibrium: the integral z holds what the model says of rest at the start, so
that of a wrong holding torque only its change along the motion is felt.
"""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.drives import PID, Drives
from dynamics.closed_loop.problem import EveryFrame, FrameTiming
from dynamics.control.inverse_dynamics import Model, Motion, spans
from dynamics.control.law import Assignment, LawInLoop
from dynamics.control.observer import Estimate


def joint_commands(model: Model, motion: Motion, timing: FrameTiming, frames: int, drives: Drives = PID) -> np.ndarray:
    """Commands (frames, n), rad or m, of the frames of a motion that starts from rest at time 0.

    Each is for the time from its arrival, after the latency, to that of the next. Raises what `Robot.inverse_dynamics`
    does where the motion leaves the reach.
    """
    period = 1 / timing.frame_rate_hz
    along = spans(model, motion, np.arange(frames) * period + timing.latency_s, period)
    law = drives.joint_law(model.parameters[model.robot.layout.joint_pid])
    lp, li, ld, c, stiff = law.lp, law.li, law.ld, law.rate_weight, law.lp + law.lx
    before, integral = model.held(motion.pose(np.zeros(1))[0], drives)
    commands = np.empty_like(along.mean)
    held = timing.hold == "zero"
    for k in range(frames):
        moved, mean = along.end[k] - along.begin[k], along.mean[k]
        by_before = ld * (c * before + moved) / period
        if held:
            left = along.torque[k] + stiff * mean + by_before - li * (integral - along.mean_integral[k])
            commands[k] = left / (lp + c * ld / period + li * period / 2)
            integral = integral + period * (commands[k] - mean)
        else:
            left = along.torque[k] + stiff * along.end[k] + by_before - li * (integral + period * (before / 2 - mean))
            commands[k] = left / (lp + c * ld / period + li * period / 2)
            integral = integral + period * ((before + commands[k]) / 2 - mean)
        before = commands[k]
    return commands


def feedforward(assignment: Assignment) -> LawInLoop:
    """The servo around these commands, which with an observer sees where the robot is as its correction arrives.

    Raises what `joint_commands` does.
    """
    settings, model = assignment.settings, assignment.model
    drives = replace(settings.drives, torques=False)
    commands = joint_commands(model, assignment.motion, settings.timing, assignment.frames, drives)
    if not assignment.feedback.observer:
        return LawInLoop(feedforward=commands, drives=drives)
    watched, gains, chart = assignment.watched(drives), settings.servo, model.robot.geometry.chart
    expected: list[Estimate] = []
    integral = np.zeros(len(chart.freedoms))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal integral
        expected.append(watched.see(frame, measured))
        at = watched.arrival(frame)
        seen, (pose, rate, _) = watched.ahead(at), assignment.desired(at)
        error = chart.coordinates(pose) - seen.coordinates
        integral = integral + assignment.period * error
        demand = gains.kp * error + gains.kd * (chart.coordinates(rate) - seen.rates) + gains.ki * integral
        jacobian = model.robot.coordinate_jacobian(chart.pose(seen.coordinates))
        issued = np.asarray(commands[frame] + jacobian @ demand)
        watched.issue(frame, issued)
        return issued

    return LawInLoop(controller=EveryFrame(command), drives=drives, expected=expected, by_servo=True)
