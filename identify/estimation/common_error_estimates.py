"""Estimates of the errors that all poses of a record have in common.

They are a by-product of the identification, a self-calibration. Let r = model - measured be the
residuals in standard deviations of the noise, and J their Jacobian with respect to the parameters.
The modes M are the changes of r by one prior standard deviation of each common error. The change dp
of the parameters and the errors z, with prior variance one, minimise |r + J dp + M z|^2 + |z|^2
plus the prior of the parameters. The search for the parameters eliminates z. With the residuals r
at its optimum, z = -(1 + M^T M)^-1 M^T r.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from identify.arrays import Array
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.record.stored_common_errors import CLOCK_DRIFT, CLOCK_OFFSET


@dataclass(frozen=True)
class CommonErrorEstimates:
    """Estimates of the common errors of one record.

    names: names of the k errors, each ending with its unit. prior_std, estimate (k,): prior
    standard deviations, and estimates. covariance (k, k): covariance of the estimates.
    with_parameters (p, k): covariance of the robot's parameters with the estimates.
    """

    names: tuple[str, ...]
    prior_std: Array
    estimate: Array
    covariance: Array
    with_parameters: Array

    @property
    def std(self) -> Array:
        """Standard deviations (k,) of the estimates."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def learned(self) -> dict[str, float]:
        """Estimates by their names."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))


def errors_of_run(run: LoopModel, parameters: Array) -> Array:
    """Return the most likely common errors (k,) of a run at the optimal parameters (p,).

    The run is one returned by `with_common_errors`. The errors are in prior standard deviations.
    """
    assert run.marginal is not None
    residuals = run.noise_residuals(parameters).ravel()
    return errors_from_residuals(run.marginal.modes, residuals)


def errors_from_residuals(modes: Array, missed: Array) -> Array:
    """Return the most likely errors (k,) for modes (m, k) and residuals (m,).

    Modes and residuals are in standard deviations of the noise alone.
    """
    # Normal equations of |missed + M z|^2 + |z|^2.
    return np.asarray(-np.linalg.solve(np.eye(modes.shape[1]) + modes.T @ modes, modes.T @ missed))


def errors_in_models(problem: OutputErrorProblem, parameters: Array) -> list[Array]:
    """Return the most likely errors (k,) of poses, loop and bodies for each run of a problem.

    The problem is one returned by `with_common_errors`. A run without common errors has an empty
    array. Errors of the geometry are left out, because no model contains them (see
    `LoopModel.errors_had`).
    """
    found = []
    for run in problem.runs:
        errors = np.zeros(0) if run.marginal is None else errors_of_run(run, parameters)
        found.append(errors[: len(run.errors_had)])
    return found


def shared_draws(runs: Sequence[LoopModel]) -> tuple[list[LoopModel], Array]:
    """Return the runs that need random numbers for common errors, and a matrix for all runs.

    Records that state the same errors with the same covariance share one set of numbers. Only the
    errors of a clock or of a start belong to a single record. The matrix (k, d) maps the standard
    normal numbers (d,) of the returned runs to those (k,) of all runs, in the order of the records.
    """
    holders = [
        next(first for first in runs if first is run or run.common.known_as(first.common))
        for run in runs
    ]
    drawing = [
        run
        for run, holder in zip(runs, holders, strict=True)
        if holder is run or run.common.of_record.any()
    ]

    def block(run: LoopModel, holder: LoopModel, drawn: LoopModel) -> Array:
        own, other = (one.whitened_modes.shape[2] for one in (run, drawn))
        matrix = np.zeros((own, other))
        if not own:
            return matrix
        of_record = run.common.of_record
        if drawn is run:
            matrix[of_record, of_record] = 1.0
        if drawn is holder:
            # The errors are the same, but each run has its own factor of their covariance.
            rows, columns = ~of_record, ~drawn.common.of_record
            factor = np.eye(int(rows.sum()))
            if run is not holder:
                own_factor = run.common.whole_factor[np.ix_(rows, rows)]
                holder_factor = holder.common.whole_factor[np.ix_(columns, columns)]
                factor = np.linalg.pinv(own_factor) @ holder_factor
            matrix[np.ix_(rows, columns)] = factor
        return matrix

    pairs = zip(runs, holders, strict=True)
    return drawing, np.vstack([np.hstack([block(*pair, one) for one in drawing]) for pair in pairs])


def covariance_by_kind(runs: Sequence[LoopModel], moved: Array) -> dict[str, Array]:
    """Return the covariance (q, q) of estimates due to each kind of common errors.

    runs: the runs that `shared_draws` returns. moved (q, k): change of the estimate by each of
    their standard normal numbers.
    """
    of_common: dict[str, Array] = {}
    for run in runs:
        own, moved = np.split(moved, [run.whitened_modes.shape[2]], axis=1)
        for kind, part in run.common.by_kind(own).items() if own.size else ():
            of_common[kind] = of_common.get(kind, 0.0) + part @ part.T
    return of_common


def common_error_estimates(
    problem: OutputErrorProblem, parameters: Array, whole: Array
) -> list[CommonErrorEstimates]:
    """Return the estimated common errors of each record of a problem `with_common_errors`.

    A record without common errors has empty estimates. parameters (p,): the optimum. whole
    (p + k, p + k): covariance of the parameters and of the common errors of all records, in prior
    standard deviations of the errors.
    """
    count = len(parameters)
    found = []
    first = count
    for run in problem.runs:
        if run.marginal is None:
            nothing = np.zeros(0)
            square = np.zeros((0, 0))
            found.append(CommonErrorEstimates((), nothing, nothing, square, np.zeros((count, 0))))
            continue
        factor = run.common.whole_factor
        own = slice(first, first + len(factor))
        first += len(factor)
        estimates = CommonErrorEstimates(
            run.common.all_names,
            np.sqrt(np.diag(factor @ factor.T)),
            factor @ errors_of_run(run, parameters),
            factor @ whole[own, own] @ factor.T,
            whole[:count, own] @ factor.T,
        )
        found.append(estimates)
    return found


def with_first_errors(problem: OutputErrorProblem, whole: Array) -> Array:
    """Return the covariance (p + k, p + k) of the parameters and of the first record's errors.

    The errors are in their own units. whole: covariance of the parameters and of the common errors
    of all records, in prior standard deviations of the errors.
    """
    count = len(problem.guess.values)
    first = problem.runs[0]
    factor = np.zeros((0, 0)) if first.marginal is None else first.common.whole_factor
    units = block_diag(np.eye(count), factor)
    kept = slice(0, units.shape[1])
    return np.asarray(units @ whole[kept, kept] @ units.T)


def clock_notes(records: Sequence[CommonErrorEstimates]) -> tuple[str, ...]:
    """Return a sentence for each record whose commands have a clock of their own."""
    notes = []
    for number, found in enumerate(records, start=1):
        std = dict(zip(found.names, found.std.tolist(), strict=True))
        said = []
        if CLOCK_OFFSET in std:
            offset = 1e3 * found.learned[CLOCK_OFFSET]
            doubt = 1e3 * std[CLOCK_OFFSET]
            said.append(f"{offset:.3f} ± {doubt:.3f} ms after their logged times")
        if CLOCK_DRIFT in std:
            drift = 1e6 * found.learned[CLOCK_DRIFT]
            doubt = 1e6 * std[CLOCK_DRIFT]
            said.append(f"{drift:.1f} ± {doubt:.1f} us later in every second")
        if said:
            of_record = f" of record {number}" if len(records) > 1 else ""
            what = ", and ".join(said)
            notes.append(
                f"the commands{of_record} act {what}: their clock differs from that of the poses"
            )
    return tuple(notes)
