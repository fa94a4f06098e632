"""Output error: difference of measured and modelled poses (eq. 32, figure 3).

There are two ways to drive the model. In the closed loop, as in the paper, the model has the servo
around it and follows the reference. Its ideal sensor has the same sampling, delay and hold as the
real sensor, and loses the same frames. Driven by commands, the joints of the model get the logged
commands, which contain the effect of the sensor's noise on the plant.

The residuals are the pose differences of all records, whitened by the sensor's covariance, and a
row for each piece of prior knowledge: the initial guess of each parameter and the scale anchor.
`model/output_error_residuals.py` computes those of a record.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array, triangular_factor
from identify.estimation.bounded_least_squares import StopCriteria
from identify.estimation.bounds import ParameterBounds, parameter_bounds
from identify.estimation.prior import StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.model.loop_model import LoopModel
from identify.scenario import Filter


@dataclass(frozen=True)
class OutputErrorProblem:
    """Least-squares problem in a robot's parameters over one or several records.

    It is solved by `bounded_least_squares.minimise`, until one of the criteria `stop` holds.
    low_pass: filter of measured poses for the linear fits at the start of a search. With
    `physical`, only masses and inertias that a rigid body can have are allowed.
    """

    runs: tuple[LoopModel, ...]
    guess: StartingGuess
    anchor: ScaleAnchor
    low_pass: Filter
    stop: StopCriteria
    physical: bool = False

    @property
    def bounds(self) -> ParameterBounds:
        """Bounds of the parameters."""
        return parameter_bounds(self.guess, self.physical)

    def driven_by_commands(self) -> "OutputErrorProblem":
        """Return a copy of the problem with joints driven by the logged commands."""
        return replace(self, runs=tuple(run.driven_by_commands() for run in self.runs))

    @property
    def bends(self) -> bool:
        """True if a model with residuals whitened for common errors is not linear in them.

        The model is nonlinear if the servo measures poses with these errors, or if there are errors
        in the loop or of bodies.
        """
        return any(
            run.common.loop_std or run.common.body_std or (run.common.names and not run.driven)
            for run in self.runs
            if run.marginal
        )

    def has(self, errors: Sequence[Array], within: float) -> bool:
        """Return whether the model of each run contains these common errors (k,).

        A difference of up to `within` standard deviations (`LoopModel.in_deciding_stds`) is
        allowed. Errors that a model cannot contain are first limited to values that it can contain.
        """
        pairs = zip(self.runs, errors, strict=True)
        return all(
            np.abs(run.in_deciding_stds(run.errors_had - run.having(own).errors_had)).max(initial=0)
            <= within
            for run, own in pairs
        )

    def having(self, errors: Sequence[Array]) -> "OutputErrorProblem":
        """Return a copy of the problem with these common errors (k,) in the model of each run."""
        return replace(
            self, runs=tuple(run.having(own) for run, own in zip(self.runs, errors, strict=True))
        )

    def with_common_errors(self, parameters: Array) -> "OutputErrorProblem":
        """Return a copy of the problem with residuals that are also whitened for common errors.

        The modes of each record are evaluated at these parameters (p,). Raises LoopFailure if the
        model is unstable.
        """
        return replace(self, runs=tuple(run.with_common_errors(parameters) for run in self.runs))

    def cost(self, parameters: Array, ahead: bool = False) -> float:
        """Return the sum of squared whitened residuals. It is infinite for an unstable model.

        With `ahead`, the runs include the sensitivities, so that a following call of `linearise`
        can reuse them.
        """
        known, _ = self.known(parameters)
        total = float(known @ known)
        try:
            for run in self.runs:
                total += float(np.sum(run.residuals(parameters, ahead) ** 2))
        except DynamicsError:
            # A search then reduces its step.
            return np.inf
        return total

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Return the cost and the triangular form of its linearisation.

        See `bounded_least_squares.Problem`. Raises LoopFailure if the model is unstable.
        """
        known, known_jacobian = self.known(parameters)
        size = len(parameters)
        cost = float(known @ known)
        # Each record is reduced to its triangular factor, which saves memory.
        triangle = np.column_stack([known_jacobian, known])
        for run in self.runs:
            residual, shown = run.linearised(parameters)
            cost += float(np.sum(residual**2))
            # Factoring costs less with the few columns of the groups than with all parameters.
            rows = triangular_factor(shown.reshape(residual.size, -1), residual.ravel())
            rows = np.column_stack([run.of_all(rows[:, :-1]), rows[:, -1]])
            triangle = triangular_factor(np.vstack([triangle, rows]))
        return cost, triangle[:size, :size], triangle[:size, size]

    def known_information(self) -> Array:
        """Return the information (p, p) of the initial guess and the scale anchor."""
        _, rows = self.known(self.guess.values)
        return np.asarray(rows.T @ rows, dtype=float)

    def known(self, parameters: Array) -> tuple[Array, Array]:
        """Return residuals (k,) of the initial guess and the scale anchor, and their Jacobian.

        The Jacobian is (k, p). Both are in standard deviations.
        """
        guess = self.guess
        anchor_rows, measured = self.anchor.row(guess.layout)
        rows = np.vstack([guess.rows, anchor_rows])
        values = np.concatenate([guess.values / guess.std, measured])
        return rows @ parameters - values, rows
