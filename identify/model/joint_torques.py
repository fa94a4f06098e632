"""Torques at the joints as changes of the joint commands with the same effect.

A drive with the gains lp, li and ld and the weight c of the commanded rate turns a change U of its
command into the additional torque

    lp U + ld c U_dot + li integral(U)

(`dynamics.closed_loop.drives`). A torque that a joint needs in addition to those of the model
therefore acts as a change of its commands, which follows from this equation command by command. A
model can thus have torques that its equation of motion lacks.

In the period h of a command, the integral grows by h U if the command is held. For a ramp, it grows
by h times the mean of U before and after the ramp. The torque T in the middle of a held command, or
at the end of a ramp, obeys in both cases

    (lp + b + li h / 2) U_k - (lp + 2 b - li h / 2) U_k-1 + b U_k-2 = T_k - T_k-1,   b = ld c / h.
"""

import numpy as np
import scipy
from scipy.interpolate import PchipInterpolator

from dynamics.closed_loop import FrameTiming
from dynamics.closed_loop.drives import JointLaw
from identify.arrays import Array


def equivalent_commands(
    torques: Array, latencies: Array, law: JointLaw, timing: FrameTiming
) -> Array:
    """Return the changes (N, ..., n), rad or m, of commands with which drives add given torques.

    The torques (N, ..., n), N m or N, are those at the frames. latencies (N,): time, s, from each
    frame until its command begins to act. Before the first command there is no torque.
    """
    period = 1.0 / timing.frame_rate_hz
    by_rate = law.ld * law.rate_weight / period
    by_integral = law.li * period / 2
    needed = _while_commands_act(torques, latencies, timing)
    commands = np.zeros_like(torques)
    for joint, (lp, b, i) in enumerate(zip(law.lp, by_rate, by_integral, strict=True)):
        weights = [lp + b + i, i - lp - 2 * b, b]
        commands[..., joint] = scipy.signal.lfilter(
            [1.0, -1.0], weights, needed[..., joint], axis=0
        )
    return commands


def _while_commands_act(values: Array, latencies: Array, timing: FrameTiming) -> Array:
    """Return values (N, ...) of the frames for the time in which the command of each frame acts.

    For a held command, this is their mean over that time, and for a ramp, the value at its end.
    """
    period = 1.0 / timing.frame_rate_hz
    times = np.arange(len(values)) * period
    begin = np.minimum(times + latencies, times[-1])
    end = np.minimum(begin + period, times[-1])
    # A cubic spline would swing about jumps, such as those of dry friction.
    spline = PchipInterpolator(times, values)
    if timing.hold == "linear":
        return np.asarray(spline(end))
    so_far = spline.antiderivative()
    duration = (end - begin).reshape(-1, *(1 for _ in values.shape[1:]))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (so_far(end) - so_far(begin)) / duration
    return np.where(duration > 0, mean, spline(end))
