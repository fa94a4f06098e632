"""What a record says of the errors that all its poses have in common: self-calibration, as a by-product.

With residuals r = model - measured in standard deviations of the noise, their Jacobian J by the parameters and the
modes M of the common errors, parameters p and errors z (of unit variance beforehand) minimise |r + J dp + M z|^2 +
|z|^2 with what is known of p. The parameters' search has z eliminated; at its optimum z = -(1 + M^T M)^-1 M^T r.
"""

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem


@dataclass(frozen=True)
class CommonErrorEstimates:
    """names of the errors of one record, each ending with its unit; prior_std, estimate and std (k,) of each."""

    names: tuple[str, ...]
    prior_std: Array
    estimate: Array
    std: Array


def common_error_estimates(problem: OutputErrorProblem, parameters: Array) -> CommonErrorEstimates:
    """What the first record of a problem `with_common_errors` says at its optimum (p,) of what its poses have in
    common."""
    run = problem.runs[0]
    if run.marginal is None:
        nothing = np.zeros(0)
        return CommonErrorEstimates((), nothing, nothing, nothing)
    names, factor, modes = run.common.all_names, run.common.whole_factor, run.marginal.modes
    whitened, slopes = run.without_common_errors().residuals(parameters)  # in standard deviations of the noise alone
    residuals = whitened.ravel()
    rows = np.column_stack([slopes.reshape(residuals.size, -1), modes])
    information = rows.T @ rows
    count = len(parameters)
    information[:count, :count] += problem.known_information()
    information[count:, count:] += np.eye(len(names))
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    found = -np.linalg.solve(np.eye(len(names)) + modes.T @ modes, modes.T @ residuals)
    spread = factor @ covariance[count:, count:] @ factor.T
    prior_std = np.sqrt(np.diag(factor @ factor.T))
    return CommonErrorEstimates(names, prior_std, factor @ found, np.sqrt(np.diag(spread)))
