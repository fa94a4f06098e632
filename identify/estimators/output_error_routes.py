"""Estimators by output error, and by its linear warm start alone.

The variants of the output error are the paper's closed loop, the model driven by the logged
commands, and the closed loop with known gains.
"""

import time
from dataclasses import replace

import numpy as np

from identify.errors import EstimationError
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.output_error_search import output_error_searches
from identify.estimation.warm_start import REWEIGHTINGS, linear_warm_start
from identify.estimators.estimator import Estimate, Evidence, estimator
from identify.progress import SilentProgress
from identify.random_streams import ROUTES_UNCERTAINTY, mixed_generator

KNOWN = 1e-6  # relative standard deviation of a known gain


@estimator("output error, unknown PID", uses="poses")
def closed_loop(evidence: Evidence) -> Estimate:
    """Estimate by closed-loop output error with unknown PID, as in the paper.

    A warm start and the command-driven search precede it.
    """
    return _searched(evidence.problem, closed_loop=True)


@estimator("output error, command driven", uses="poses")
def command_driven(evidence: Evidence) -> Estimate:
    """Estimate by output error of the model driven by the logged commands."""
    return _searched(evidence.problem, closed_loop=False)


@estimator("output error, known PID", uses="poses, gains")
def known_pid(evidence: Evidence) -> Estimate:
    """Estimate by closed-loop output error with known gains of the joint PID.

    Raises EstimationError if the gains are not known.
    """
    if evidence.known_gains is None:
        raise EstimationError(
            "the gains of the joint PID are not known: this estimator needs lp, li and ld"
        )
    guess = evidence.problem.guess
    values = guess.values.copy()
    std = guess.std.copy()
    gains = guess.layout.joint_pid
    # Gains that the law does not read remain fixed at zero.
    read = ~guess.fixed[gains]
    values[gains] = np.where(read, evidence.known_gains, 0.0)
    std[gains] = np.where(read, KNOWN * np.abs(evidence.known_gains), std[gains])
    known = replace(guess, values=values, std=std)
    return _searched(replace(evidence.problem, guess=known), closed_loop=True)


@estimator("linear warm start alone", uses="poses")
def warm_start_alone(evidence: Evidence) -> Estimate:
    """Estimate by the linear closed-loop equation with the logged commands, without a search.

    The estimate has no standard deviations.
    """
    began = time.perf_counter()
    parameters = linear_warm_start(evidence.problem)
    return Estimate(parameters, None, time.perf_counter() - began, REWEIGHTINGS, 0)


def _searched(problem: OutputErrorProblem, closed_loop: bool) -> Estimate:
    began = time.perf_counter()
    warm = linear_warm_start(problem)
    # The final search gives the estimate. The searches before it provide its start.
    searches = list(output_error_searches(problem, warm, closed_loop, SilentProgress()).values())
    seconds = time.perf_counter() - began
    final = searches[-1].solution
    std = estimate_uncertainty(
        searches[-1].linearised(), final.parameters, mixed_generator(ROUTES_UNCERTAINTY)
    ).std
    iterations = sum(one.solution.iterations for one in searches)
    evaluations = sum(one.solution.evaluations for one in searches)
    return Estimate(final.parameters, std, seconds, iterations, evaluations, final.stop_reason)
