"""Output error in its variants: the paper's, driven by the logged commands, with known gains; and its warm start."""

import time
from dataclasses import replace

import numpy as np

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.covariance import estimate_uncertainty
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import output_error_searches
from identify.estimation.warm_start import REWEIGHTINGS, linear_warm_start
from identify.estimators.evidence import Estimate, Evidence
from identify.loop_parameters import NAMES, StartingGuess
from identify.progress import SilentProgress
from identify.random_streams import ROUTES_UNCERTAINTY, mixed_generator

GAINS = slice(64, 67)

KNOWN = 1e-6
"""Relative standard deviation of a gain that is known."""


def closed_loop(evidence: Evidence) -> Estimate:
    """Closed-loop output error with unknown PID, as in the paper; warm start and command-driven search before it."""
    return _searched(evidence, evidence.problem, "closed_loop")


def command_driven(evidence: Evidence) -> Estimate:
    """Output error of the model driven by the logged commands."""
    return _searched(evidence, evidence.problem, "command_driven")


def known_pid(evidence: Evidence) -> Estimate:
    """Closed-loop output error with the joint PID's gains known. Raises EstimationError where they are not."""
    if evidence.known_gains is None:
        raise EstimationError("the gains of the joint PID are not known: this estimator needs lp, li and ld")
    values, std = evidence.problem.guess.values.copy(), evidence.problem.guess.std.copy()
    values[GAINS] = evidence.known_gains
    std[GAINS] = KNOWN * np.abs(evidence.known_gains)
    return _searched(evidence, replace(evidence.problem, guess=StartingGuess(values, std)), "closed_loop")


def warm_start_alone(evidence: Evidence) -> Estimate:
    """The linear closed-loop equation with the logged commands, solved once; no standard deviations."""
    began = time.perf_counter()
    parameters = _warm(evidence, evidence.problem)
    return Estimate(parameters, None, time.perf_counter() - began, REWEIGHTINGS, 0)


def _searched(evidence: Evidence, problem: OutputErrorProblem, method: str) -> Estimate:
    began = time.perf_counter()
    scenario = evidence.scenario.with_overrides({"identification.method": method})
    found = output_error_searches(problem, scenario, _warm(evidence, problem), SilentProgress()).values()
    seconds = time.perf_counter() - began
    last = list(found)[-1]
    judged = problem if method == "closed_loop" else problem.driven_by_commands()
    counts = sum(one.iterations for one in found), sum(one.evaluations for one in found)
    return Estimate(last.parameters, _std(judged, last.parameters), seconds, *counts, last.stop_reason)


def _warm(evidence: Evidence, problem: OutputErrorProblem) -> Array:
    scenario = evidence.scenario
    return linear_warm_start(problem.runs, scenario.timing, scenario.filter, problem.guess, problem.anchor)


def _std(problem: OutputErrorProblem, parameters: Array) -> Array:
    covariance = estimate_uncertainty(problem, parameters, mixed_generator(ROUTES_UNCERTAINTY)).covariance
    return np.asarray(np.sqrt(np.diag(covariance)).reshape(len(NAMES)), dtype=float)
