"""Causes in the gains of the drives: gains that differ between joints, where the model shares them.

The gains of the first joint are those of the model. The gains of all other joints can differ from
them.
"""

import numpy as np

from dynamics.closed_loop.drives import READS
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.diagnosis.cause import Cause, OnGain, in_each_run
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.model.unequal_gains import with_unequal_gains

STEP = 1e-3
"""Change of a gain for differences, as a share of the gain."""

LEAST = -0.9
"""Least difference, as a share of the gain. A law needs gains above zero."""


def gain_causes(problem: OutputErrorProblem, parameters: Array) -> tuple[Cause, ...]:
    """Return the gains that can differ from those of the first joint, at an optimum (p,)."""
    run = problem.runs[0]
    layout = run.robot.layout
    if layout.own_gains:
        return ()
    # a gain at its bound has the size of the initial guess
    gains = np.where(parameters > 0, parameters, problem.guess.values)[layout.joint_pid]
    return tuple(
        _difference(joint, kind, float(gains[kind]), layout.unit(layout.joint_pid_names[kind]))
        for joint in range(1, layout.joints)
        for kind, name in enumerate(JOINT_PID)
        if name in READS[run.settings.drives.law] and gains[kind] > 0
    )


def _difference(joint: int, kind: int, gain: float, unit: str) -> Cause:
    """Return a gain of a joint beyond that of the first joint."""

    def changed(run: LoopModel, size: float) -> LoopModel:
        differences = np.zeros((run.robot.layout.joints, len(JOINT_PID)))
        differences[joint, kind] = size
        return with_unequal_gains(run, differences)

    return Cause(
        name=f"{JOINT_PID[kind]} of joint {joint + 1}, beyond that of joint 1",
        unit=unit,
        group="gains that differ between joints",
        change=in_each_run(changed),
        step=STEP * gain,
        remedy=lambda size: "--set model.gains=each",
        least=LEAST * gain,
        effect=OnGain(joint, kind),
    )
