"""Multiple shooting: fits to short segments, for models that do not run through a whole record.

A model that is unstable, or that leaves the reach of the robot, has no output error over a whole
record. Driven by the logged commands, such a model still has an output error over segments of half
a second. The first segment of a record starts in equilibrium. Every other segment starts from its
own state, which is unknown like the parameters. A state holds the coordinates of the platform,
their rates, and the integrals of the joint PID. For m coordinates and n joints these are
s = 2 m + n numbers. The end of each segment must agree with the start of the next segment within
the accuracy of the sensor, so that at the optimum the segments form one run.

In the linearised problem the states form a chain. They are eliminated one after the other by QR,
which leaves a problem in the parameters alone (condensing; Bock and Plitt, "A multiple shooting
algorithm for direct solution of optimal control problems", IFAC 1984). The step of the states
follows from the step of the parameters.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from dynamics import DynamicsError
from dynamics.closed_loop import (
    ClosedLoopRun,
    Reference,
    StartState,
    differentiate_commands,
    equilibrium,
    simulate_commands,
)
from dynamics.kinematics.platform import Chart
from identify.arrays import Array
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.warm_start import effective_command, running_integral
from identify.filtering import filtered_derivatives
from identify.model.loop_model import LoopModel
from identify.model.torque_model import commands_before
from identify.scenario import Filter

# Length of a segment, s. It is a few periods of the joint loop. In this time an unstable loop does
# not leave the reach.
SEGMENT_S = 0.5
# Bandwidth of the joint loop, rad/s. It converts the sensor's noise into standard deviations of
# rates and integrals.
BANDWIDTH = 20.0


@dataclass(frozen=True)
class Segment:
    """Segment of a run, from its frame `first` to its frame `last`.

    The last frame of a segment is the first frame of the next segment. reference: the run's
    reference at the frames of the segment. state_std (s,): standard deviation of a state that
    corresponds to the sensor's noise.
    """

    run: LoopModel
    reference: Reference
    first: int
    last: int
    state_std: Array

    @property
    def ends_the_run(self) -> bool:
        """True for the last segment."""
        return self.last == len(self.run.ok) - 1

    @property
    def chart(self) -> Chart:
        """Chart of the platform's coordinates."""
        return self.run.robot.geometry.chart

    @property
    def measured(self) -> Array:
        """Measured poses (frames, 6)."""
        return self.run.measured[self.first : self.last + 1]

    def simulate(
        self, parameters: Array, state: Array, sensitivities: bool = False
    ) -> ClosedLoopRun:
        """Simulate the model from a state (s,).

        The first segment starts in equilibrium, whatever the state. Raises LoopFailure if the
        segment cannot be simulated.
        """
        run = self.run
        chart = self.chart
        count = len(chart.freedoms)
        coordinates, rates, integral = np.split(state, [count, 2 * count])
        pose = chart.pose(coordinates)
        at_rest = np.zeros(count)  # integral of the servo, which does not act
        start = None
        # Only the first segment begins in equilibrium.
        if self.first:
            before, latencies = commands_before(run, self.first)
            start = StartState(
                pose, chart.lifted(rates), integral, at_rest, before, pose, latencies=latencies
            )
        frames = slice(self.first, self.last + 1)
        commands = run.logged[frames]
        late = None if run.latencies is None else run.latencies[frames]
        given = run.robot, parameters + run.payload, self.reference, run.settings, commands
        if sensitivities:
            return differentiate_commands(*given, start=start, latencies=late, by_start=True)
        return simulate_commands(*given, start=start, latencies=late)

    def whitened(self, values: Array) -> Array:
        """Return pose values (frames, 6, ...) whitened and stacked, (n, ...).

        Lost frames and the first frame of the next segment are left out.
        """
        count = self.last - self.first + self.ends_the_run
        rows = values[:count][self.run.ok[self.first : self.first + count]]
        return np.einsum("ij,nj...->ni...", self.run.whitener, rows).reshape(-1, *values.shape[2:])


def segments(run: LoopModel) -> list[Segment]:
    """Return the segments of a run. All have about the same length."""
    frames = len(run.ok)
    count = max(1, round((frames - 1) / (SEGMENT_S * run.settings.timing.frame_rate_hz)))
    edges = np.linspace(0, frames - 1, count + 1).round().astype(int)
    free = run.robot.geometry.chart.basis
    covariance = free.T @ run.covariance @ free
    jacobian = run.robot.coordinate_jacobian(run.reference.poses[0])
    coordinate_std = np.sqrt(np.diag(covariance))
    joint_std = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    std = np.concatenate([coordinate_std, BANDWIDTH * coordinate_std, joint_std / BANDWIDTH])
    poses = run.reference.poses
    rates = run.reference.rates
    chain = []
    for first, last in pairwise(edges):
        reference = Reference(poses[first : last + 1], rates[first : last + 1])
        chain.append(Segment(run, reference, int(first), int(last), std))
    return chain


def measured_states(chain: list[Segment], parameters: Array, low_pass: Filter) -> Array:
    """Return the states (segments, s) at the starts of a run's segments.

    They are filtered coordinates of the platform, their rates, and the integrals of the joint PID.
    At the start of the run, the integrals hold the model with parameters (p,) at rest.
    """
    run = chain[0].run
    rate_hz = run.settings.timing.frame_rate_hz
    measured = run.robot.geometry.chart.coordinates(run.without_gaps())
    smooth, rate, _ = filtered_derivatives(measured, rate_hz, low_pass.cutoff_hz, low_pass.order)
    _, _, command_integral = effective_command(run, low_pass)
    angle_integral = running_integral(run.robot.inverse_kinematics(run.robot.pose(smooth)), rate_hz)
    servo = run.settings.servo
    drives = run.settings.drives
    rest = equilibrium(
        run.robot, parameters + run.payload, run.reference.poses[0], servo, drives=drives
    )
    states = np.hstack([smooth, rate, rest.joint_integral + command_integral - angle_integral])
    return np.asarray(states[[part.first for part in chain]], dtype=float)


def end_state(run: ClosedLoopRun, chart: Chart) -> Array:
    """Return the state (s,) at the last frame of a run of a robot with this chart."""
    coordinates = chart.coordinates(run.pose[-1])
    rates = chart.coordinates(run.pose_rate[-1])
    return np.concatenate([coordinates, rates, run.joint_integral[-1]])


@dataclass
class MultipleShooting:
    """Least-squares problem in a robot's p parameters, for `bounded_least_squares.minimise`.

    chains: segments of each record. states: states (segments, s) of each record at the latest
    linearisation. For other parameters, the states are extrapolated by that linearisation.
    """

    problem: OutputErrorProblem
    chains: list[list[Segment]]
    states: list[Array]
    _at: Array = field(default_factory=lambda: np.zeros(0))
    _eliminated: list[list[Array]] = field(default_factory=list)

    def cost(self, parameters: Array) -> float:
        """Return the sum of squared residuals of poses, continuity and prior.

        It is infinite if a segment cannot be simulated.
        """
        known, _ = self.problem.known(parameters)
        total = float(known @ known)
        try:
            for chain, states in zip(self.chains, self._moved(parameters), strict=True):
                for k, part in enumerate(chain):
                    run = part.simulate(parameters, states[k])
                    total += float(np.sum(part.whitened(run.pose - part.measured) ** 2))
                    if not part.ends_the_run:
                        jump = end_state(run, part.chart) - states[k + 1]
                        total += float(np.sum((jump / part.state_std) ** 2))
        except DynamicsError:
            return np.inf
        return total

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Return cost and condensed linearisation, see `bounded_least_squares.Problem`.

        Raises LoopFailure if a segment cannot be simulated.
        """
        # The states make the step that the previous linearisation predicts.
        self.states = self._moved(parameters)
        self._at = parameters.copy()
        self._eliminated = []
        known, known_rows = self.problem.known(parameters)
        size = len(parameters)
        cost = float(known @ known)
        condensed = np.column_stack([known_rows, known])
        for chain, states in zip(self.chains, self.states, strict=True):
            count = states.shape[1]
            # Nothing depends on the first state. These identity rows keep this state unchanged, and
            # make the elimination possible.
            carried = np.eye(count, count + size + 1)
            eliminated = []
            for k, part in enumerate(chain):
                following = None if part.ends_the_run else states[k + 1]
                rows = _linearised(part, parameters, states[k], following)
                cost += float(np.sum(rows[:, -1] ** 2))
                # Columns of zeros for the next state are inserted.
                carried = np.insert(carried, [count] * count, 0.0, axis=1)
                triangle = np.asarray(np.linalg.qr(np.vstack([carried, rows]), mode="r"))
                eliminated.append(triangle[:count])
                carried = triangle[count:, count:]
            condensed = np.vstack([condensed, carried[:, count:]])
            self._eliminated.append(eliminated)
        triangle = np.asarray(np.linalg.qr(condensed, mode="r"))
        return cost, triangle[:size, :size], triangle[:size, size]

    def _moved(self, parameters: Array) -> list[Array]:
        """Return the states after the step from the latest linearisation to parameters (p,)."""
        if not self._eliminated:
            return self.states
        step = np.append(parameters - self._at, 1.0)
        chains = zip(self.states, self._eliminated, strict=True)
        return [_moved_chain(states, eliminated, step) for states, eliminated in chains]


def _linearised(part: Segment, parameters: Array, state: Array, following: Array | None) -> Array:
    """Return the linearised residuals of a segment, and of its continuity with the next segment.

    The next segment begins at the state `following`. The columns are the derivatives with respect
    to the segment's state, the following state and the parameters, and then the values. The
    derivatives with respect to the state of the first segment are zero (see `Segment.simulate`).
    """
    run = part.simulate(parameters, state, sensitivities=True)
    by_state = np.asarray(run.start_sensitivity)
    by_parameters = np.asarray(run.pose_sensitivity)
    end_by_state = np.asarray(run.end_start_sensitivity)
    end_by_parameters = np.asarray(run.end_sensitivity)
    depends = float(part.first > 0)
    size = len(part.state_std)
    values = part.whitened(run.pose - part.measured)
    own = depends * part.whitened(by_state[:, :, :size])
    rows = np.column_stack([own, np.zeros_like(own), part.whitened(by_parameters), values])
    if following is None:
        return rows
    own = depends * end_by_state[:size, :size]
    jump = end_state(run, part.chart) - following
    # Continuity rows are in standard deviations of a state.
    continuity = np.column_stack([own, -np.eye(size), end_by_parameters[:size], jump])
    return np.vstack([rows, continuity / part.state_std[:, None]])


def _moved_chain(states: Array, eliminated: list[Array], step: Array) -> Array:
    """Return the states (segments, s) after a step (p + 1,) of the parameters.

    The last entry of the step is 1. eliminated: triangular factor of each state.
    """
    moved = states.copy()
    size = states.shape[1]
    # Step of the state at the start of a segment, from the last segment to the first.
    state_step: Array = np.zeros(size)
    for k in reversed(range(len(states))):
        triangle = eliminated[k]
        known = triangle[:, size : 2 * size] @ state_step + triangle[:, 2 * size :] @ step
        state_step = np.asarray(-np.linalg.solve(triangle[:, :size], known), dtype=float)
        moved[k] += state_step
    return moved
