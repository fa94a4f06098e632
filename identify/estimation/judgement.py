"""What the records decide of each parameter and group: whether it is identified, in what interval, and at what risk."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.estimation.base_parameters import (
    base_parameters,
    rank_by_threshold,
    reference_regressor,
    structural_regressor,
)
from identify.estimation.bounded_intervals import bounded_estimate
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.conditioning import Conditioning, conditioning
from identify.estimation.estimate_covariance import Uncertainty
from identify.estimation.explanation import Explanation
from identify.estimation.group_estimates import GroupEstimates, group_estimates, group_rows
from identify.estimation.identifiability import identifiability
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import bounds_of
from identify.estimation.prior_support import rests_on_prior
from identify.loop_parameters import NAMES
from identify.scenario import Scenario


@dataclass(frozen=True)
class Judgement:
    """identifiable, rests_on_prior (67,) bool; intervals (67, 2) and group_intervals: 95 %, cut at the bounds;
    base_rank: independent groups that the references excite by the paper's rule; active_bounds: what holds the estimate
    back; warnings: what a reader must know before believing any of it."""

    identifiable: NDArray[np.bool_]
    rests_on_prior: NDArray[np.bool_]
    intervals: Array
    groups: GroupEstimates
    group_intervals: Array
    conditioning: Conditioning
    base_rank: int
    active_bounds: tuple[str, ...]
    warnings: tuple[str, ...]


def judge(
    problem: OutputErrorProblem,
    scenario: Scenario,
    solution: Solution,
    uncertainty: Uncertainty,
    explanation: Explanation,
) -> Judgement:
    """Judge what a search found, given its uncertainty and how well it explains the records."""
    robot, guess, estimate = problem.runs[0].robot, problem.guess, solution.parameters
    base, known = base_parameters(structural_regressor(robot)), problem.known_information()
    criterion = identifiability(guess, robot, model_holds=explanation.model_holds)
    identifiable = criterion.judge(np.eye(len(NAMES)), uncertainty.covariance)
    conditioned = conditioning(uncertainty.information, known, base, guess, estimate)
    bounded = bounded_estimate(
        estimate,
        solution.at_bound,
        uncertainty.gradient,
        uncertainty.information + known,
        uncertainty.covariance,
        bounds_of(problem, scenario),
    )
    of_the_records = (warning for run in problem.runs for warning in run.warnings())
    return Judgement(
        identifiable=identifiable,
        rests_on_prior=identifiable & rests_on_prior(base, problem.anchor, estimate, criterion.sizes),
        intervals=bounded.intervals(np.eye(len(NAMES))),
        groups=group_estimates(base, guess, criterion, estimate, uncertainty.covariance),
        group_intervals=bounded.intervals(group_rows(base)),
        conditioning=conditioned,
        base_rank=_excited_rank(problem, scenario),
        active_bounds=bounded.active_bounds,
        warnings=(
            *of_the_records,
            *uncertainty.warnings(),
            *explanation.warnings(),
            *bounded.warnings(),
            *conditioned.warnings(),
        ),
    )


def _excited_rank(problem: OutputErrorProblem, scenario: Scenario) -> int:
    """Independent groups that the records' references excite, by the paper's rule."""
    rate_hz = scenario.timing.frame_rate_hz
    excited = [reference_regressor(run.robot, run.reference, rate_hz) for run in problem.runs]
    return rank_by_threshold(np.concatenate(excited), scenario.identification.qr_threshold)
