"""Multiple shooting: the record in short segments, for models that do not run through the whole of it.

A model that is unstable, or that leaves the reachable set, has no output error over a record. Over half a second it has
one, where each segment starts from its own state. These states are unknowns beside the parameters, and each segment
must end where the next starts, up to what the sensor can see, so that in the optimum the segments make up one run.

In the linearised problem the states form a chain. They are eliminated one after the other by QR, which leaves a problem
in the parameters alone (condensing; Bock and Plitt, "A multiple shooting algorithm for direct solution of optimal
control problems", IFAC 1984); the step of the states follows from that of the parameters.
"""

from dataclasses import dataclass, field

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.record_segments import STATES, Segment, end_state


@dataclass
class MultipleShooting:
    """Least-squares problem in the 67 parameters, for `bounded_least_squares.minimise`.

    chains: the segments of each record; states: a (segments, 18) for each record. The states follow the parameters by
    the latest linearisation, and are moved with each new one.
    """

    problem: OutputErrorProblem
    chains: list[list[Segment]]
    states: list[Array]
    _at: Array = field(default_factory=lambda: np.zeros(0))
    _eliminated: list[list[Array]] = field(default_factory=list)

    def cost(self, parameters: Array) -> float:
        """Sum of squared residuals of poses, continuity and what is known; infinite where a segment does not run."""
        known, _ = self.problem.known(parameters)
        total = float(known @ known)
        try:
            for chain, states in zip(self.chains, self._moved(parameters), strict=True):
                for k, part in enumerate(chain):
                    run = part.simulate(parameters, states[k])
                    total += float(np.sum(part.whitened(run.pose - part.measured) ** 2))
                    if not part.ends_the_run:
                        total += float(np.sum(((end_state(run) - states[k + 1]) / part.state_std) ** 2))
        except DynamicsError:
            return np.inf
        return total

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost and the condensed linearisation in the parameters, see `bounded_least_squares.Problem`.

        Raises LoopFailure where a segment does not run.
        """
        self.states = self._moved(parameters)
        self._at, self._eliminated = parameters.copy(), []
        known, known_rows = self.problem.known(parameters)
        size, cost = len(parameters), float(known @ known)
        condensed = np.column_stack([known_rows, known])
        for chain, states in zip(self.chains, self.states, strict=True):
            carried, eliminated = np.eye(STATES, STATES + size + 1), []  # nothing depends on the first state: it stays
            for k, part in enumerate(chain):
                rows = _linearised(part, parameters, states[k], None if part.ends_the_run else states[k + 1])
                cost += float(np.sum(rows[:, -1] ** 2))
                carried = np.insert(carried, [STATES] * STATES, 0.0, axis=1)  # columns of the next state
                triangle = np.asarray(np.linalg.qr(np.vstack([carried, rows]), mode="r"))
                eliminated.append(triangle[:STATES])
                carried = triangle[STATES:, STATES:]
            condensed = np.vstack([condensed, carried[:, STATES:]])
            self._eliminated.append(eliminated)
        triangle = np.asarray(np.linalg.qr(condensed, mode="r"))
        return cost, triangle[:size, :size], triangle[:size, size]

    def _moved(self, parameters: Array) -> list[Array]:
        """The states after the step from the latest linearisation to parameters (67,)."""
        if not self._eliminated:
            return self.states
        step = np.append(parameters - self._at, 1.0)
        chains = zip(self.states, self._eliminated, strict=True)
        return [_moved_chain(states, eliminated, step) for states, eliminated in chains]


def _linearised(part: Segment, parameters: Array, state: Array, following: Array | None) -> Array:
    """Rows of a segment's residuals and of its continuity with the `following` state, in the columns of its state, the
    following one, the parameters, and the value. The first segment starts in equilibrium: its state does not count."""
    run = part.simulate(parameters, state, sensitivities=True)
    by_state, by_parameters, end_by_state, end_by_parameters = (
        np.asarray(one)
        for one in (run.start_sensitivity, run.pose_sensitivity, run.end_start_sensitivity, run.end_sensitivity)
    )
    counts = float(part.first > 0)
    values, own = part.whitened(run.pose - part.measured), counts * part.whitened(by_state[:, :, :STATES])
    rows = np.column_stack([own, np.zeros_like(own), part.whitened(by_parameters), values])
    if following is None:
        return rows
    own, gap = counts * end_by_state[:STATES, :STATES], end_state(run) - following
    joint = np.column_stack([own, -np.eye(STATES), end_by_parameters[:STATES], gap])
    return np.vstack([rows, joint / part.state_std[:, None]])


def _moved_chain(states: Array, eliminated: list[Array], step: Array) -> Array:
    """States (segments, 18) after a step (68,) of the parameters (its last entry 1), by the triangles of their QR."""
    moved = states.copy()
    following: Array = np.zeros(STATES)
    for k in reversed(range(len(states))):
        triangle = eliminated[k]
        right = triangle[:, STATES : 2 * STATES] @ following + triangle[:, 2 * STATES :] @ step
        following = np.asarray(-np.linalg.solve(triangle[:, :STATES], right), dtype=float)
        moved[k] += following
    return moved
