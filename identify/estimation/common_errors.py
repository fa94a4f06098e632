"""What a record says of the errors that all its poses have in common: self-calibration, as a
by-product.

With residuals r = model - measured in standard deviations of the noise, their Jacobian J by the
parameters and the modes M of the common errors, parameters p and errors z (of unit variance
beforehand) minimise |r + J dp + M z|^2 + |z|^2 with what is known of p. The parameters' search has
z eliminated; at its optimum z = -(1 + M^T M)^-1 M^T r.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel


@dataclass(frozen=True)
class CommonErrorEstimates:
    """names of the errors of one record, each ending with its unit; prior_std and estimate (k,) of
    each, covariance (k, k), and that of the robot's parameters with them (p, k)."""

    names: tuple[str, ...]
    prior_std: Array
    estimate: Array
    covariance: Array
    with_parameters: Array

    @property
    def std(self) -> Array:
        """Standard deviations (k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def learned(self) -> dict[str, float]:
        """The estimate of each by its name."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))


def most_likely(run: LoopModel, parameters: Array) -> Array:
    """The common errors (k,) of a run `with_common_errors` at the optimum (p,), in standard
    deviations beforehand.
    """
    assert run.marginal is not None
    missed = run.without_common_errors().misses(parameters).ravel() - run.marginal.had
    return most_likely_of(run.marginal.modes, missed)


def most_likely_of(modes: Array, missed: Array) -> Array:
    """Those (k,) with modes (m, k) of residuals (m,), all in standard deviations of the noise
    alone.
    """
    return np.asarray(-np.linalg.solve(np.eye(modes.shape[1]) + modes.T @ modes, modes.T @ missed))


def most_likely_errors(problem: OutputErrorProblem, parameters: Array) -> list[Array]:
    """Of each run of a problem `with_common_errors`, the most likely ones (k,) of those that a
    model can have.
    """
    return [
        np.zeros(0) if run.marginal is None else most_likely(run, parameters)[: len(run.errors_had)]
        for run in problem.runs
    ]


def shared_draws(runs: Sequence[LoopModel]) -> tuple[list[LoopModel], Array]:
    """The first run of each draw of errors in common to all poses, and what makes the numbers of
    all runs (k,), record by record, of those of these alone (k, d). Records that state the same
    errors, equally well known, share a draw."""
    firsts: list[LoopModel] = []
    for run in runs:
        if not any(run.common.known_as(first.common) for first in firsts):
            firsts.append(run)

    def made_of(run: LoopModel, first: LoopModel) -> Array:
        own, other = (one.whitened_modes.shape[2] for one in (run, first))
        if run is first:
            return np.eye(own)
        if not own or not run.common.known_as(first.common):
            return np.zeros((own, other))
        return np.asarray(np.linalg.pinv(run.common.whole_factor) @ first.common.whole_factor)

    return firsts, np.vstack([np.hstack([made_of(run, first) for first in firsts]) for run in runs])


def covariance_by_kind(runs: Sequence[LoopModel], moved: Array) -> dict[str, Array]:
    """Covariance (p, p) of an estimate that each kind of errors in common to all poses of a record
    makes; moved (p, k): what each of their numbers makes of it, run by run."""
    of_common: dict[str, Array] = {}
    for run in runs:
        own, moved = np.split(moved, [run.whitened_modes.shape[2]], axis=1)
        for kind, part in run.common.by_kind(own).items() if own.size else ():
            of_common[kind] = of_common.get(kind, 0.0) + part @ part.T
    return of_common


def common_error_estimates(
    problem: OutputErrorProblem, parameters: Array, whole: Array
) -> CommonErrorEstimates:
    """What the first record of a problem `with_common_errors` says at its optimum (p,) of what its
    poses have in common; whole (p + k, p + k): covariance of parameters and of that, in standard
    deviations beforehand."""
    run = problem.runs[0]
    count = len(parameters)
    if run.marginal is None:
        nothing = np.zeros(0)
        return CommonErrorEstimates((), nothing, nothing, np.zeros((0, 0)), np.zeros((count, 0)))
    factor = run.common.whole_factor
    own = slice(count, count + len(factor))
    return CommonErrorEstimates(
        run.common.all_names,
        np.sqrt(np.diag(factor @ factor.T)),
        factor @ most_likely(run, parameters),
        factor @ whole[own, own] @ factor.T,
        whole[:count, own] @ factor.T,
    )
