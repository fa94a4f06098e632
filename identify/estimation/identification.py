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

from dynamics import Robot
from identify.arrays import Array
from identify.cores import one_thread
from identify.errors import EstimationError
from identify.estimation import warm_start
from identify.estimation.base_parameters import (
    base_parameters,
    rank_by_threshold,
    reference_regressor,
    structural_regressor,
)
from identify.estimation.bounded_intervals import bounded_estimate
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.conditioning import Conditioning, conditioning
from identify.estimation.estimate_covariance import DRAWS, Uncertainty, estimate_uncertainty
from identify.estimation.group_estimates import GroupEstimates, group_estimates, group_rows
from identify.estimation.identifiability import identifiability
from identify.estimation.loop_parameters import NAMES, starting_guess
from identify.estimation.misfit import Misfit, misfit_of_white
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import bounds_of, output_error_searches
from identify.estimation.prior_support import rests_on_prior
from identify.estimation.scale_anchor import ScaleAnchor, read_anchor
from identify.estimation.whiteness import LAGS, Whiteness, whiteness
from identify.progress import Progress, SilentProgress
from identify.record.recorded_run import recorded_run
from identify.scenario import Scenario

UNCERTAINTY_STREAM = 5
"""Random stream of the repeated experiments, beside those of the experiment."""


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
        RecordError: the record misses something, or belongs to another robot or frame rate.
        EstimationError: no robot or scenario, too many lost frames, or no model that runs from the starting guess or
            the warm start.
    """
    progress = progress or SilentProgress()
    records = [record] if isinstance(record, xr.Dataset) else list(record)
    problem = output_error_problem(records, robot, scenario)
    began = time.perf_counter()
    warm = warm_start.linear_warm_start(problem.runs, scenario.timing, scenario.filter, problem.guess, problem.anchor)
    warmed = time.perf_counter()
    searches = output_error_searches(problem, scenario, warm, progress)
    searched = time.perf_counter()
    method, driven = scenario.identification.method, problem.driven_by_commands()
    seed = int(records[0].attrs.get("seed", 0))  # a record of a real robot has none
    rng = np.random.default_rng([seed, UNCERTAINTY_STREAM])
    with progress.stage("uncertainty", DRAWS) as advance:
        judged = problem if method == "closed_loop" else driven
        uncertainty = estimate_uncertainty(judged, searches[method].parameters, rng, advance)
    residuals, ok = _driven_residuals(driven, searches["command_driven"].parameters)
    tested, driven_misfit = whiteness(residuals, ok), misfit_of_white(residuals[ok])
    ended = time.perf_counter()
    seconds = {"warm_start": warmed - began, "search": searched - warmed, "uncertainty": ended - searched}
    return _result(problem, scenario, warm, searches, uncertainty, tested, driven_misfit, seconds)


def output_error_problem(records: Sequence[xr.Dataset], robot: Robot, scenario: Scenario) -> OutputErrorProblem:
    """The output-error problem of one or several records; the first brings the scale anchor.

    Raises:
        RecordError: no scale anchor, or no such poses.
        EstimationError: no robot or scenario; a record that does not fit, or cannot carry an identification.
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
    settings = scenario.identification
    guess = starting_guess(robot, scenario.model.start_parameters, settings.start_std, settings.prior)
    return OutputErrorProblem(runs, guess, anchor)


def _driven_residuals(driven: OutputErrorProblem, parameters: Array) -> tuple[Array, NDArray[np.bool_]]:
    """All command-driven residuals (N, 6), NaN where lost, and the good frames (N,): one record after the other, with a
    gap of all lags of the whiteness test between them."""
    gap, residuals, ok = np.full((LAGS, 6), np.nan), [], []
    for run in driven.runs:
        rows = np.full(run.measured.shape, np.nan)
        rows[run.ok] = run.whiten(run.model_poses(parameters) - run.measured)
        residuals += [rows, gap]
        ok += [run.ok, np.zeros(LAGS, dtype=bool)]
    return np.concatenate(residuals), np.concatenate(ok)


def _result(
    problem: OutputErrorProblem,
    scenario: Scenario,
    warm: Array,
    searches: dict[str, Solution],
    uncertainty: Uncertainty,
    tested: Whiteness,
    driven_misfit: Misfit,
    seconds: dict[str, float],
) -> IdentificationResult:
    """What the searches and their uncertainty say of parameters and groups."""
    robot, guess, solution = problem.runs[0].robot, problem.guess, searches[scenario.identification.method]
    base, known = base_parameters(structural_regressor(robot)), problem.known_information()
    # An error of the model that the closed loop hides shows where the logged commands drive it.
    hidden = driven_misfit.decides and not uncertainty.misfit.decides
    criterion = identifiability(guess, robot, model_holds=not (hidden or uncertainty.misfit.decides))
    identifiable = criterion.judge(np.eye(len(NAMES)), uncertainty.covariance)
    groups = group_estimates(base, guess, criterion, solution.parameters, uncertainty.covariance)
    conditioned = conditioning(uncertainty.information, known, base, guess, solution.parameters)
    bounded = bounded_estimate(
        solution.parameters,
        solution.at_bound,
        uncertainty.gradient,
        uncertainty.information + known,
        uncertainty.covariance,
        bounds_of(problem, scenario),
    )
    of_the_records = (warning for run in problem.runs for warning in run.warnings())
    return IdentificationResult(
        names=NAMES,
        initial=guess.values,
        warm_start=warm,
        estimate=solution.parameters,
        std=np.sqrt(np.diag(uncertainty.covariance)),
        covariance=uncertainty.covariance,
        intervals=bounded.intervals(np.eye(len(NAMES))),
        identifiable=identifiable,
        rests_on_prior=identifiable & rests_on_prior(base, problem.anchor, solution.parameters, criterion.sizes),
        groups=groups,
        group_intervals=bounded.intervals(group_rows(base)),
        conditioning=conditioned,
        scale_anchor=problem.anchor,
        base_rank=_excited_rank(problem, scenario),
        iterations=sum(one.iterations for one in searches.values()),
        evaluations=sum(one.evaluations for one in searches.values()),
        stop_reason=solution.stop_reason,
        searches=tuple(searches),
        costs=tuple(one.costs for one in searches.values()),
        active_bounds=bounded.active_bounds,
        noise_ratio=uncertainty.misfit.found,
        expected_noise_ratio=uncertainty.misfit.expected,
        noise_ratio_std=uncertainty.misfit.std,
        whiteness=tested,
        warnings=(
            *of_the_records,
            *uncertainty.warnings(),
            *(driven_misfit.warnings("driven by the logged commands, the model") if hidden else ()),
            *tested.warnings(),
            *bounded.warnings(),
            *conditioned.warnings(),
        ),
        seconds=seconds,
    )


def _excited_rank(problem: OutputErrorProblem, scenario: Scenario) -> int:
    """Independent groups that the records' references excite, by the paper's rule."""
    rate_hz = scenario.timing.frame_rate_hz
    excited = [reference_regressor(run.robot, run.reference, rate_hz) for run in problem.runs]
    return rank_by_threshold(np.concatenate(excited), scenario.identification.qr_threshold)
