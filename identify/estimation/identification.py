"""Identification of one record: linear warm start, output error, uncertainty, identifiability.

Sees the record, the robot's geometry and starting guess, and the scenario's model side; never the sensor, the plant's
settings or the truth.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dynamics import DynamicsError, Robot
from dynamics.closed_loop.problem import checked_loop_parameters
from identify.arrays import Array
from identify.errors import EstimationError, ScenarioError
from identify.estimation.base_parameters import Conditioning
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.covariance import DRAWS, Uncertainty, estimate_uncertainty
from identify.estimation.explanation import Explanation, Whiteness, explanation
from identify.estimation.identifiability import GroupEstimates, Judgement, judge
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import output_error_searches
from identify.estimation.scale_anchor import ScaleAnchor, read_anchor
from identify.estimation.warm_start import linear_warm_start
from identify.loop_parameters import NAMES, StartingGuess, starting_guess
from identify.progress import Progress, SilentProgress
from identify.random_streams import UNCERTAINTY, mixed_generator
from identify.record.provenance import recorded_seed
from identify.record.recorded_run import recorded_run
from identify.runtime import one_thread
from identify.scenario import Scenario


@dataclass(frozen=True)
class IdentificationResult:
    """What one record says about the 67 parameters, in the order of `names`; SI.

    initial, warm_start, estimate, std (67,), covariance (67, 67), the last two as they were without bounds; intervals
    (67, 2): 95 %, cut at the bounds; identifiable (67,) bool; rests_on_prior (67,) bool: identified, but only with what
    the guess says of other parameters; groups, group_intervals: what the record says of the base parameters;
    base_rank: independent groups that the trajectory excites by the paper's rule; iterations and evaluations: of all
    searches; stop_reason: of the last; searches: their names in order, and costs: after each iteration, one tuple a
    search; active_bounds: what holds the estimate back, as "platform.Izz <= Ixx + Iyy";
    noise_ratio: mean squared whitened residual, to compare with expected_noise_ratio, what the sensor's noise alone
    would leave, give or take noise_ratio_std; whiteness: test of the residuals of the model driven by the logged
    commands.
    """

    names: tuple[str, ...]
    initial: Array
    warm_start: Array
    estimate: Array
    std: Array
    covariance: Array
    intervals: Array
    identifiable: NDArray[np.bool_]
    rests_on_prior: NDArray[np.bool_]
    groups: GroupEstimates
    group_intervals: Array
    conditioning: Conditioning
    scale_anchor: ScaleAnchor
    base_rank: int
    iterations: int
    evaluations: int
    stop_reason: str
    searches: tuple[str, ...]
    costs: tuple[tuple[float, ...], ...]
    active_bounds: tuple[str, ...]
    noise_ratio: float
    expected_noise_ratio: float
    noise_ratio_std: float
    whiteness: Whiteness
    warnings: tuple[str, ...]
    seconds: dict[str, float]


@one_thread
def identify(
    record: xr.Dataset | Sequence[xr.Dataset],
    robot: Robot,
    scenario: Scenario,
    progress: Progress | None = None,
) -> IdentificationResult:
    """Estimate the parameters of robot and joint PID from one or several records by closed-loop output error.

    Raises:
        RecordError: the record misses something, such as its scenario or its scale anchor, or states what is none, such
            as a seed that is no whole number.
        EstimationError: no robot or scenario; a record of another robot, timing or servo, or one that cannot carry an
            identification; no model that runs from the starting guess or the warm start, or that bears the noise.
        ScenarioError: a parameter set that the robot does not have, or a starting guess that no model has.
        dynamics.DynamicsError: poses that the robot cannot reach.
    """
    progress = progress or SilentProgress()
    records = [record] if isinstance(record, xr.Dataset) else list(record)
    problem = output_error_problem(records, robot, scenario)
    rng = mixed_generator(UNCERTAINTY, recorded_seed(records[0]))
    began = time.perf_counter()
    warm = linear_warm_start(problem, scenario)
    warmed = time.perf_counter()
    searches = output_error_searches(problem, scenario, warm, progress)
    searched = time.perf_counter()
    method, driven = scenario.identification.method, problem.driven_by_commands()
    with progress.stage("uncertainty", DRAWS) as advance:
        judged = problem if method == "closed_loop" else driven
        uncertainty = estimate_uncertainty(judged, searches[method].parameters, rng, advance)
    explained = explanation(driven, searches["command_driven"].parameters, uncertainty.misfit)
    judgement = judge(problem, scenario, searches[method], uncertainty, explained)
    ended = time.perf_counter()
    seconds = {"warm_start": warmed - began, "search": searched - warmed, "uncertainty": ended - searched}
    return _result(problem, warm, searches, uncertainty, explained, judgement, seconds)


def output_error_problem(records: Sequence[xr.Dataset], robot: Robot, scenario: Scenario) -> OutputErrorProblem:
    """The output-error problem of one or several records; the first brings the scale anchor.

    Raises:
        RecordError: no scale anchor, or no such poses.
        EstimationError: no robot or scenario; a record that does not fit, or cannot carry an identification.
        ScenarioError: no such starting guess, or one that no model has.
    """
    for given, kind, loader in ((robot, Robot, "dynamics.load_robot"), (scenario, Scenario, "identify.load_scenario")):
        if not isinstance(given, kind):
            raise EstimationError(f"{given!r} is no {kind.__name__}: {loader}(name or path) gives one")
    if not records:
        raise EstimationError("no record to identify from")
    runs = tuple(recorded_run(record, robot, scenario) for record in records)
    anchor = read_anchor(records[0])
    if anchor.name == "payload" and len({float(run.payload @ run.payload) for run in runs}) < 2:
        raise EstimationError(
            f"the scale anchor is a payload, and the {len(runs)} records have all the same load: one with and one "
            "without it are needed"
        )
    return OutputErrorProblem(runs, _guess(robot, scenario), anchor)


def _guess(robot: Robot, scenario: Scenario) -> StartingGuess:
    """The scenario's starting guess. Raises ScenarioError where the robot has none of the name, or no model has it."""
    settings = scenario.identification
    guess = starting_guess(robot, scenario.model.start_parameters, settings.start_std, settings.prior)
    try:
        checked_loop_parameters(guess.values)
    except DynamicsError as error:
        known = ", ".join(settings.prior) or "nothing"
        raise ScenarioError(
            f"no model has the starting guess (set {scenario.model.start_parameters!r}, known beforehand: {known}): "
            f"{error}"
        ) from None
    return guess


def _result(
    problem: OutputErrorProblem,
    warm: Array,
    searches: dict[str, Solution],
    uncertainty: Uncertainty,
    explained: Explanation,
    judgement: Judgement,
    seconds: dict[str, float],
) -> IdentificationResult:
    """What each step found, as one result; the last search brings the estimate."""
    solution = list(searches.values())[-1]
    return IdentificationResult(
        names=NAMES,
        initial=problem.guess.values,
        warm_start=warm,
        estimate=solution.parameters,
        std=np.sqrt(np.diag(uncertainty.covariance)),
        covariance=uncertainty.covariance,
        intervals=judgement.intervals,
        identifiable=judgement.identifiable,
        rests_on_prior=judgement.rests_on_prior,
        groups=judgement.groups,
        group_intervals=judgement.group_intervals,
        conditioning=judgement.conditioning,
        scale_anchor=problem.anchor,
        base_rank=judgement.base_rank,
        iterations=sum(one.iterations for one in searches.values()),
        evaluations=sum(one.evaluations for one in searches.values()),
        stop_reason=solution.stop_reason,
        searches=tuple(searches),
        costs=tuple(one.costs for one in searches.values()),
        active_bounds=judgement.active_bounds,
        noise_ratio=explained.misfit.found,
        expected_noise_ratio=explained.misfit.expected,
        noise_ratio_std=explained.misfit.std,
        whiteness=explained.whiteness,
        warnings=judgement.warnings,
        seconds=seconds,
    )
