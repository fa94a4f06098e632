"""A record cut into short segments, through each of which the model runs from a state of its own.

The model is driven by the logged commands. Its state is what it then starts from: pose, pose rate and joint PID
integral.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dynamics.closed_loop import ClosedLoopRun, Reference, StartState, equilibrium, simulate
from dynamics.closed_loop.problem import MAX_DELAY_FRAMES
from identify.arrays import Array
from identify.estimation.warm_start import effective_command, running_integral
from identify.record.filtering import filtered_derivatives
from identify.record.recorded_run import RecordedRun
from identify.scenario import Filter, Timing

SEGMENT_S = 0.5
"""Length of a segment: a few periods of the joint loop, in which an unstable one does not leave the reachable set."""

BANDWIDTH = 20.0
"""rad/s, of the joint loop: turns the sensor's noise into a deviation of rates and integrals."""

STATES = 18
"""Entries of a state: pose (6,), pose rate (6,), joint PID integral (6,)."""


@dataclass(frozen=True)
class Segment:
    """Frames first to last of a run; the last one is the next segment's first. state_std (18,): what the sensor's noise
    is in a state."""

    run: RecordedRun
    reference: Reference
    first: int
    last: int
    state_std: Array

    @property
    def ends_the_run(self) -> bool:
        """Whether no segment follows."""
        return self.last == len(self.run.ok) - 1

    @property
    def measured(self) -> Array:
        """Measured poses (frames, 6)."""
        return self.run.measured[self.first : self.last + 1]

    def simulate(self, parameters: Array, state: Array, sensitivities: bool = False) -> ClosedLoopRun:
        """The model's run from a state (18,); the first segment starts in equilibrium. Raises LoopFailure."""
        run = self.run
        return simulate(
            run.robot,
            parameters + run.payload,
            self.reference,
            run.settings,
            start=self._start(state) if self.first else None,
            sensitivities=sensitivities,
            start_sensitivities=sensitivities,
            commands=run.logged[self.first : self.last + 1],
        )

    def whitened(self, values: Array) -> Array:
        """Pose values (frames, 6, ...) whitened and stacked (n, ...), without lost frames and the next segment's."""
        count = self.last - self.first + self.ends_the_run
        rows = values[:count][self.run.ok[self.first : self.first + count]]
        return np.einsum("ij,nj...->ni...", self.run.whitener, rows).reshape(-1, *values.shape[2:])

    def _start(self, state: Array) -> StartState:
        before = self.run.logged[max(0, self.first - MAX_DELAY_FRAMES - 2) : self.first]
        pose, rate, integral = state.reshape(3, 6)
        return StartState(pose, rate, integral, np.zeros(6), before, pose)


def segments(run: RecordedRun) -> list[Segment]:
    """The segments of a run, all of about the same length."""
    frames = len(run.ok)
    count = max(1, round((frames - 1) / (SEGMENT_S * run.settings.timing.frame_rate_hz)))
    edges = np.linspace(0, frames - 1, count + 1).round().astype(int)
    jacobian = run.robot.pose_jacobian(run.reference.poses[0])
    pose = np.sqrt(np.diag(run.covariance))
    angle = np.sqrt(np.diag(jacobian @ run.covariance @ jacobian.T))
    std = np.concatenate([pose, BANDWIDTH * pose, angle / BANDWIDTH])
    poses, rates = run.reference.poses, run.reference.rates
    return [
        Segment(run, Reference(poses[first : last + 1], rates[first : last + 1]), int(first), int(last), std)
        for first, last in pairwise(edges)
    ]


def measured_states(chain: list[Segment], parameters: Array, timing: Timing, filtering: Filter) -> Array:
    """States (segments, 18) at the starts of a run's segments: filtered poses and rates, and what the joint PID has
    integrated since the start, where it held the model of parameters (67,) at rest."""
    run = chain[0].run
    pose, rate, _ = filtered_derivatives(run.without_gaps(), timing.frame_rate_hz, filtering.cutoff_hz, filtering.order)
    _, _, command_integral = effective_command(run.logged, timing, filtering)
    angle_integral = running_integral(run.robot.inverse_kinematics(pose), timing.frame_rate_hz)
    rest = equilibrium(run.robot, parameters + run.payload, run.reference.poses[0], run.settings.servo)
    states = np.hstack([pose, rate, rest.joint_integral + command_integral - angle_integral])
    return np.asarray(states[[part.first for part in chain]], dtype=float)


def end_state(run: ClosedLoopRun) -> Array:
    """State (18,) at the last frame of a run."""
    return np.concatenate([run.pose[-1], run.pose_rate[-1], run.joint_integral[-1]])
