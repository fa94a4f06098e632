"""What a record says of the errors that all its poses have in common: self-calibration, as a by-product.

With residuals r = model - measured in standard deviations of the noise, their Jacobian J by the parameters and the
modes M of the common errors, parameters p and errors z (of unit variance beforehand) minimise |r + J dp + M z|^2 +
|z|^2 with what is known of p. The parameters' search has z eliminated; at its optimum z = -(1 + M^T M)^-1 M^T r.
"""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem
from identify.record.recorded_run import RecordedRun


@dataclass(frozen=True)
class CommonErrorEstimates:
    """names of the errors of one record, each ending with its unit; prior_std, estimate and std (k,) of each.

    Of the robot's parameters the estimates depend by by_parameters (k, p); covariance (k, k): of the errors, were those
    known.
    """

    names: tuple[str, ...]
    prior_std: Array
    estimate: Array
    std: Array
    covariance: Array
    by_parameters: Array

    def with_parameters(self, covariance: Array) -> Array:
        """Covariance (p + k, p + k) of parameters, of which that is known (p, p), and errors together."""
        beside = self.by_parameters @ covariance
        return np.block([[covariance, beside.T], [beside, self.covariance + beside @ self.by_parameters.T]])


def most_likely(run: RecordedRun, parameters: Array) -> Array:
    """The common errors (k,) of a run `with_common_errors` at the optimum (p,), in standard deviations beforehand."""
    assert run.marginal is not None
    modes, had = run.marginal.modes, run.marginal.had
    missed = run.without_common_errors().misses(parameters).ravel() - had  # in standard deviations of the noise alone
    return np.asarray(-np.linalg.solve(np.eye(modes.shape[1]) + modes.T @ modes, modes.T @ missed))


def most_likely_errors(problem: OutputErrorProblem, parameters: Array) -> list[Array]:
    """Of each run of a problem `with_common_errors`, the most likely ones (k,) of those that a model can have."""
    return [
        np.zeros(0) if run.marginal is None else most_likely(run, parameters)[: len(run.errors_had)]
        for run in problem.runs
    ]


def common_error_estimates(problem: OutputErrorProblem, parameters: Array) -> CommonErrorEstimates:
    """What the first record of a problem `with_common_errors` says at its optimum (p,) of what its poses have in
    common."""
    run = problem.runs[0]
    if run.marginal is None:
        nothing = np.zeros(0)
        empty, beside = np.zeros((0, 0)), np.zeros((0, len(parameters)))
        return CommonErrorEstimates((), nothing, nothing, nothing, empty, beside)
    names, factor, modes = run.common.all_names, run.common.whole_factor, run.marginal.modes
    slopes = run.without_common_errors().residuals(parameters)[1].reshape(len(modes), -1)
    rows = np.column_stack([slopes, modes])
    information = rows.T @ rows
    count = len(parameters)
    information[:count, :count] += problem.known_information()
    information[count:, count:] += np.eye(len(names))
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    spread = factor @ covariance[count:, count:] @ factor.T
    prior_std = np.sqrt(np.diag(factor @ factor.T))
    left = np.linalg.inv(np.eye(modes.shape[1]) + modes.T @ modes)
    estimate, std = factor @ most_likely(run, parameters), np.sqrt(np.diag(spread))
    return CommonErrorEstimates(
        names, prior_std, estimate, std, factor @ left @ factor.T, -factor @ left @ modes.T @ slopes
    )
