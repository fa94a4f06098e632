"""Identification of one record: warm start, output error, uncertainty, identifiability.

Sees the record, the robot's geometry and starting guess, and the scenario's model side; never the sensor, the plant's
settings or the truth.
"""

import time
from dataclasses import dataclass

import numpy as np
import xarray as xr

from dynamics import DynamicsError, Robot
from dynamics.closed_loop import Reference
from identify import warm_start
from identify.arrays import Array
from identify.base_parameters import base_rank
from identify.bounded_least_squares import Solution, StopCriteria, minimise
from identify.errors import EstimationError
from identify.loop_parameters import NAMES, StartingGuess, starting_guess
from identify.loop_setup import model_settings
from identify.output_error import OutputErrorProblem
from identify.progress import Progress, SilentProgress
from identify.recording import poses
from identify.residual_covariance import parameter_covariance
from identify.scale_anchor import ScaleAnchor, read_anchor
from identify.scenario import Scenario

IDENTIFIABLE_SHARE = 0.5
"""A parameter counts as identified when the record at least halves the standard deviation of the starting guess."""

MINIMUM_GOOD_SHARE = 0.5
"""Share of frames that must have been measured."""


@dataclass(frozen=True)
class IdentificationResult:
    """What one record says about the 67 parameters, in the order of `names`; SI.

    initial, warm_start, estimate, std (67,), covariance (67, 67); identifiable (67,) bool; base_rank: independent
    dynamic parameter groups the trajectory excites; costs: after each iteration; noise_ratio: mean squared whitened
    residual, 1 where the sensor's noise explains everything.
    """

    names: tuple[str, ...]
    initial: Array
    warm_start: Array
    estimate: Array
    std: Array
    covariance: Array
    identifiable: Array
    scale_anchor: ScaleAnchor
    base_rank: int
    iterations: int
    evaluations: int
    stop_reason: str
    costs: tuple[float, ...]
    noise_ratio: float
    seconds: dict[str, float]


def identify(
    record: xr.Dataset, robot: Robot, scenario: Scenario, progress: Progress | None = None
) -> IdentificationResult:
    """Estimate the parameters of robot and joint PID from one record by closed-loop output error.

    Raises:
        RecordError: the record misses something, or belongs to another robot or frame rate.
        EstimationError: too many lost frames, or no model that runs from the starting guess or the warm start.
    """
    progress = progress or SilentProgress()
    settings = scenario.identification
    problem = output_error_problem(record, robot, scenario)
    with progress.stage("identify", settings.max_iterations) as advance:
        began = time.perf_counter()
        warm = _warm_start(problem, record, scenario)
        start = _best_start(problem, warm)
        warmed = time.perf_counter()
        criteria = StopCriteria(settings.cost_tolerance, settings.parameter_tolerance, settings.max_iterations)
        lower = np.zeros(len(NAMES))
        lower[NAMES.index("platform.mass")] = 1e-3 * problem.guess.values[0]
        lower[NAMES.index("joint_pid.li")] = 1e-3 * problem.guess.values[-2]
        solution = minimise(problem, start, lower, problem.guess.std, criteria, lambda i, cost: advance())
        ended = time.perf_counter()
    return _result(problem, warm, solution, robot, scenario, {"warm_start": warmed - began, "search": ended - warmed})


def output_error_problem(record: xr.Dataset, robot: Robot, scenario: Scenario) -> OutputErrorProblem:
    """The output-error problem of a record.

    Raises:
        RecordError: no scale anchor, or no such poses.
        EstimationError: too many lost frames.
    """
    _check_origin(record, robot, scenario)
    ok = record["measured_ok"].values.astype(bool)
    if ok.mean() < MINIMUM_GOOD_SHARE:
        raise EstimationError(
            f"only {ok.sum()} of {len(ok)} frames were measured; at least {MINIMUM_GOOD_SHARE:.0%} are needed"
        )
    rates = np.hstack([record["reference_velocity"].values, record["reference_orientation_rate"].values])
    return OutputErrorProblem(
        robot=robot,
        settings=model_settings(scenario),
        reference=Reference(poses(record, "reference"), rates),
        measured=poses(record, "measured"),
        ok=ok,
        covariance=record["measured_covariance"].values[ok].mean(axis=0),
        guess=starting_guess(robot, scenario.model.start_parameters, scenario.identification.start_std),
        anchor=read_anchor(record),
    )


def _check_origin(record: xr.Dataset, robot: Robot, scenario: Scenario) -> None:
    if record.attrs.get("robot") != robot.name:
        raise EstimationError(f"the record is of robot {record.attrs.get('robot')!r}, not of {robot.name!r}")
    rate = float(record.attrs.get("frame_rate_hz", 0.0))
    if abs(rate - scenario.timing.frame_rate_hz) > 1e-9 * rate:
        raise EstimationError(f"the record has {rate:g} frames a second, the scenario {scenario.timing.frame_rate_hz:g}")


def _warm_start(problem: OutputErrorProblem, record: xr.Dataset, scenario: Scenario) -> Array:
    measured = _without_gaps(problem.measured, problem.ok)
    commands = record["command"].values
    arguments = (scenario.timing, scenario.filter, problem.guess, problem.anchor)
    return warm_start.linear_warm_start(problem.robot, measured, commands, *arguments)


def _without_gaps(measured: Array, ok: Array) -> Array:
    """Measured poses with lost frames interpolated in time; for the linear fit only."""
    frames = np.arange(len(ok))
    return np.column_stack([np.interp(frames, frames[ok], column[ok]) for column in measured.T])


def _best_start(problem: OutputErrorProblem, warm: Array) -> Array:
    """The better of warm start and starting guess; the latter's loop may be unstable."""
    guess: StartingGuess = problem.guess
    costs = [(problem.cost(start), index) for index, start in enumerate((warm, guess.values))]
    cost, index = min(costs)
    if not np.isfinite(cost):
        raise EstimationError(
            f"neither the warm start nor the starting guess gives a loop that runs: {_why(problem, warm)}"
        )
    return (warm, guess.values)[index]


def _why(problem: OutputErrorProblem, parameters: Array) -> str:
    try:
        problem.model_poses(parameters)
    except DynamicsError as error:
        return str(error)
    return "the cost is not finite"


def _result(
    problem: OutputErrorProblem,
    warm: Array,
    solution: Solution,
    robot: Robot,
    scenario: Scenario,
    seconds: dict[str, float],
) -> IdentificationResult:
    began = time.perf_counter()
    residual, jacobian = problem.residuals(solution.parameters)
    covariance = parameter_covariance(solution.factor, residual, jacobian, scenario.timing.frame_rate_hz)
    std = np.sqrt(np.diag(covariance))
    seconds["uncertainty"] = time.perf_counter() - began
    return IdentificationResult(
        names=NAMES,
        initial=problem.guess.values,
        warm_start=warm,
        estimate=solution.parameters,
        std=std,
        covariance=covariance,
        identifiable=std < IDENTIFIABLE_SHARE * problem.guess.std,
        scale_anchor=problem.anchor,
        base_rank=base_rank(robot, problem.reference, scenario),
        iterations=solution.iterations,
        evaluations=solution.evaluations,
        stop_reason=solution.stop_reason,
        costs=solution.costs,
        noise_ratio=float(np.mean(residual**2)),
        seconds=seconds,
    )
