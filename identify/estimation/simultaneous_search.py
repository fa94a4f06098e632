"""Simultaneous search for the parameters and for common errors with wide priors.

Examples of such errors are the state at a start in motion, and the clock of the commands. They move
the optimum of the parameters far away. A search that eliminates these errors is right only near the
values about which the model was linearised. Here they are unknowns like the parameters. The search
minimises

    |r(p, z)|^2 + |z|^2 + |prior(p)|^2

over the parameters p and the errors z, which are in units of their prior standard deviations. The
residuals r are whitened for all other errors. A search that eliminates z has the same optimum.
"""

from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array, triangular_factor
from identify.estimation.bounded_least_squares import Linearisation, minimise
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.record.stored_common_errors import Marginal

MOST = 30
"""Largest number of steps."""


def with_likely_errors(
    problem: OutputErrorProblem, start: Array
) -> tuple[OutputErrorProblem, Array]:
    """Return the problem with its most likely common errors, and the optimal parameters (p,).

    problem: result of `with_common_errors` at the parameters start (p,). Raises LoopFailure if the
    model is unstable at the start or with the result.
    """
    bounds = problem.bounds
    joint = JointProblem(problem, tuple(JointRun.of(run, start) for run in problem.runs))
    coordinates = bounds.coordinates(start)
    errors = np.concatenate([one.run.errors_had[one.run.contained] for one in joint.parts])
    least = np.concatenate([one.run.lowest_drawn[one.run.contained] for one in joint.parts])
    found = minimise(
        joint,
        np.concatenate([coordinates, errors]),
        np.concatenate([bounds.lower, least]),
        np.concatenate([bounds.spread(coordinates, problem.guess.std), np.ones(len(errors))]),
        replace(problem.stop, max_iterations=MOST),
        # If joints stick near the start, many steps fail. Linearising them ahead would be wasted,
        # because modes take more time than a run.
        ahead=False,
    )
    parameters, runs = joint.runs_at(found.parameters)
    near = problem.having([run.errors_had for run in runs])
    return near.with_common_errors(parameters), parameters


@dataclass(frozen=True)
class JointRun:
    """Model of one run whose errors in the loop and of bodies are unknowns.

    run: model at the start of the search, without whitening for common errors. start (p,):
    parameters at the start. modes (m, k): modes of the unknown errors at the start. others:
    whitener for all other errors, with their modes at the start, or None without other errors.
    """

    run: LoopModel
    start: Array
    modes: Array
    others: Marginal | None

    @classmethod
    def of(cls, run: LoopModel, start: Array) -> "JointRun":
        """Return the joint run of a model that was whitened for common errors at start (p,)."""
        modes = run.whitened_modes.reshape(-1, run.whitened_modes.shape[2])
        rest = np.delete(modes, run.contained, axis=1)
        unwhitened = replace(run, common=replace(run.common, geometry=None), marginal=None)
        # Runs that are already simulated remain valid, because whitening does not change them.
        unwhitened.known_runs.update(run.known_runs)
        others = Marginal.of(rest) if rest.size else None
        return cls(unwhitened, start, modes[:, run.contained], others)

    def modes_at(self, run: LoopModel, parameters: Array) -> Array:
        """Return the modes (m, k) of the unknown errors of a run at parameters (p,)."""
        if run is self.run and np.array_equal(parameters, self.start):
            return self.modes
        seen = run.whitener @ run.modes(parameters)[run.ok][:, :, run.contained]
        return np.asarray(seen.reshape(self.modes.shape))

    def whiten(self, rows: Array) -> Array:
        """Return rows (m,) or (m, k) in standard deviations of the noise, whitened for `others`."""
        return rows if self.others is None else self.others.whiten(rows)


@dataclass(frozen=True)
class JointProblem:
    """Least-squares problem in the coordinates of the parameters and in the errors of each run.

    The unknowns are the coordinates, and then the errors run by run. See
    `bounded_least_squares.Problem`.
    """

    problem: OutputErrorProblem
    parts: tuple[JointRun, ...]

    def runs_at(self, unknowns: Array) -> tuple[Array, list[LoopModel]]:
        """Return the parameters (p,) of the unknowns, and the runs with the errors among them."""
        bounds = self.problem.bounds
        coordinates, errors = np.split(unknowns, [len(bounds.lower)])
        runs = []
        for one in self.parts:
            drawn = one.run.errors_had.copy()
            drawn[one.run.contained], errors = np.split(errors, [len(drawn[one.run.contained])])
            had = one.run.errors_had
            runs.append(one.run if np.array_equal(drawn, had) else one.run.having(drawn))
        return bounds.parameters(coordinates), runs

    def cost(self, unknowns: Array) -> float:
        """Return the cost. It is infinite for an unstable model."""
        parameters, runs = self.runs_at(unknowns)
        known, _ = self.problem.known(parameters)
        total = float(known @ known)
        try:
            for one, run in zip(self.parts, runs, strict=True):
                missed = one.whiten(run.residuals(parameters).ravel())
                errors = run.errors_had[run.contained]
                total += float(missed @ missed + errors @ errors)
        except DynamicsError:
            # The search then reduces its step.
            return np.inf
        return total

    def linearise(self, unknowns: Array) -> Linearisation:
        """Return the cost and its linearisation. Raises LoopFailure for an unstable model."""
        parameters, runs = self.runs_at(unknowns)
        size = len(parameters)
        slope = self.problem.bounds.slope(unknowns[:size])
        known, known_rows = self.problem.known(parameters)
        cost = float(known @ known)
        triangle = np.zeros((len(known), len(unknowns) + 1))
        triangle[:, :size] = known_rows @ slope
        triangle[:, -1] = known
        first = size
        for one, run in zip(self.parts, runs, strict=True):
            errors = run.errors_had[run.contained]
            # Modes come first, because their run is cached and also gives the residuals.
            modes = one.modes_at(run, parameters)
            missed, shown = run.linearised(parameters)
            whitened = one.whiten(missed.ravel())
            cost += float(whitened @ whitened + errors @ errors)
            columns = np.column_stack([shown.reshape(missed.size, -1), modes])
            reduced = triangular_factor(one.whiten(columns), whitened)
            own = slice(first, first + len(errors))
            rows = np.zeros((len(reduced) + len(errors), len(unknowns) + 1))
            filled = rows[: len(reduced)]
            filled[:, :size] = run.of_all(reduced[:, : shown.shape[2]]) @ slope
            filled[:, own] = reduced[:, shown.shape[2] : -1]
            filled[:, -1] = reduced[:, -1]
            rows[len(reduced) :, own] = np.eye(len(errors))
            rows[len(reduced) :, -1] = errors
            triangle = triangular_factor(np.vstack([triangle, rows]))
            first = own.stop
        return cost, triangle[: len(unknowns), :-1], triangle[: len(unknowns), -1]
