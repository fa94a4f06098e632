"""Identification from records: linear warm start, output error, uncertainty, identifiability.

Its input is the records, the robot's geometry and initial guess, and the model's side of the
scenario. It has no access to the sensor, the plant's settings or the truth.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TypeAlias

import xarray as xr

from dynamics import DynamicsError, Robot
from dynamics.checks import shown
from dynamics.closed_loop.drives import DriveName
from dynamics.closed_loop.start_state import checked_loop_parameters
from identify.errors import EstimationError, ScenarioError
from identify.estimation.base_parameters import structure
from identify.estimation.bounded_least_squares import StopCriteria
from identify.estimation.clock_hint import clock_hints
from identify.estimation.common_error_estimates import (
    clock_notes,
    common_error_estimates,
    with_first_errors,
)
from identify.estimation.covariance import DRAWS, estimate_uncertainty
from identify.estimation.drive_choice import choose_drive
from identify.estimation.explanation import explanation
from identify.estimation.identifiability import judge
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.output_error_search import output_error_searches
from identify.estimation.prior import model_guess
from identify.estimation.result import IdentificationResult
from identify.estimation.scale_anchor import read_anchor
from identify.estimation.warm_start import linear_warm_start
from identify.model.from_record import identified_model
from identify.model.model_side import ModelSide, model_side, side_of_record
from identify.progress import Progress, SilentProgress
from identify.random_streams import UNCERTAINTY, mixed_generator
from identify.record.conditions import SERVO, command_time_warnings, drift_warnings, recorded_law
from identify.record.files_of_record import robot_of_record, warn_of_changed_robot
from identify.record.from_telemetry import reading_notes
from identify.record.known_geometry import known_geometry
from identify.record.provenance import recorded_scenario, recorded_seed
from identify.record.recording import is_timed, read
from identify.runtime import one_thread
from identify.scenario import Scenario
from identify.scenario.sections import Identification

Record: TypeAlias = xr.Dataset | str | PathLike[str]  # record, or the path of its netCDF file


@dataclass(frozen=True)
class Asked:
    """Records of an identification, and what else the estimator knows."""

    records: list[xr.Dataset]
    side: ModelSide
    settings: Identification


def identify(
    record: Record | Sequence[Record],
    robot: Robot | None = None,
    scenario: Scenario | None = None,
    progress: Progress | None = None,
) -> IdentificationResult:
    """Estimate the parameters of robot and joint PID from records by output error.

    The model closes its own loop. It gets the logged commands instead if `identification.method` of
    the scenario is "command_driven", or if a record is timed or its law is not the servo.

    Parameters
    ----------
    record : xarray.Dataset or path, or sequence of them
        One or several records of the same robot, or the paths of their netCDF files. The scale
        anchor, the seed and a missing scenario are read from the first record.
    robot : Robot, optional
        Robot with its known geometry. The default is the robot of the scenario, from its file. If
        the file is missing, it is the robot that the record holds.
    scenario : Scenario, optional
        Settings of the estimator. The default is the scenario in the first record.
    progress : Progress, optional
        Display of the progress.

    Returns
    -------
    IdentificationResult
        Estimates with their uncertainty, and tests of the model.

    Raises
    ------
    RecordError
        A record is incomplete, for example without a scenario or scale anchor, or has an invalid
        value, such as a seed that is not a whole number.
    EstimationError
        An argument has the wrong type, or there is no record. A record is of another robot, or is
        not suitable for an identification. The first record has another timing or servo than the
        scenario. The scale anchor is a payload, and all records have the same load. No stable model
        is found from the initial guess or the warm start.
    ScenarioError
        The robot lacks the parameter set that the scenario names, or the initial guess is not
        valid for the model.
    dynamics.DynamicsError
        The robot cannot reach a pose of the record.

    Warns
    -----
    UserWarning
        The robot file is missing, or its initial guess or its errors of bodies and joints have
        changed since the record was made.

    Examples
    --------
    >>> import identify
    >>> record = identify.run_experiment(identify.load_scenario("quick", renderer="statistical"))
    >>> result = identify.identify(record)
    >>> result.robot.name, bool(result.identifiable.any())
    ('rss6', True)
    """
    return identified(asked_of(record, robot, scenario), progress or SilentProgress())


@one_thread
def identified(asked: Asked, progress: Progress) -> IdentificationResult:
    """Return the result of `identify` from checked inputs. Raises the same errors."""
    began = time.perf_counter()
    records = asked.records
    side = asked.side
    robot = side.robot
    settings = asked.settings
    # The model can simulate only the servo. For other laws it gets the logged commands.
    by_servo = all(recorded_law(record) == SERVO and not is_timed(record) for record in records)
    closed_loop = by_servo and settings.method == "closed_loop"

    def problem_under(law: DriveName) -> OutputErrorProblem:
        return output_error_problem(records, side.with_drive(law), settings)

    problem = output_error_problem(records, side, settings)
    # Drives with torque commands have no law.
    in_loop = not any(run.settings.drives.torques for run in problem.runs)
    drive = choose_drive(problem_under, side.model, progress, in_loop)
    if drive.asked:
        problem = problem_under(drive.law)
    # With the record's seed, the same record always gives the same intervals.
    rng = mixed_generator(UNCERTAINTY, recorded_seed(records[0]))
    chosen = time.perf_counter()
    warm = linear_warm_start(problem)
    warmed = time.perf_counter()
    searches = output_error_searches(problem, warm, closed_loop, progress)
    searched = time.perf_counter()
    by_commands = searches["command_driven"]
    final = searches["closed_loop"] if closed_loop else by_commands
    solution = final.solution
    judged = final.linearised()
    with progress.stage("uncertainty", DRAWS) as advance:
        uncertainty = estimate_uncertainty(judged, solution.parameters, rng, advance)
    # Residuals of a right model are white only if the logged commands drive it.
    driven = by_commands.linearised() if closed_loop else judged
    explained = explanation(driven, by_commands.solution.parameters, uncertainty.misfit, rng)
    judgement = judge(problem, settings.qr_threshold, solution, uncertainty, explained)
    errors = common_error_estimates(judged, solution.parameters, uncertainty.whole)
    warned = (
        *(() if explained.model_holds else clock_hints(problem, warm, explained.misfit.found)),
        *command_time_warnings(records, side.timing),
        *drift_warnings(records),
    )
    ended = time.perf_counter()
    return IdentificationResult(
        layout=robot.layout,
        nominal=robot,
        drive=drive,
        initial=problem.guess.values,
        warm_start=warm,
        estimate=solution.parameters,
        std=uncertainty.std,
        covariance=uncertainty.covariance,
        sources={
            kind: with_first_errors(judged, part) for kind, part in uncertainty.sources.items()
        },
        scale_anchor=problem.anchor,
        common_errors=errors[0],
        iterations=sum(one.solution.iterations for one in searches.values()),
        evaluations=sum(one.solution.evaluations for one in searches.values()),
        stop_reason=solution.stop_reason,
        searches=tuple(searches),
        costs=tuple(one.solution.costs for one in searches.values()),
        noise_ratio=explained.misfit.found,
        expected_noise_ratio=explained.misfit.expected,
        noise_ratio_std=explained.misfit.std,
        whiteness=explained.whiteness,
        driven_estimate=by_commands.solution.parameters,
        driven_misfit=explained.driven_misfit,
        seconds={
            "drive": chosen - began,
            "warm_start": warmed - chosen,
            "search": searched - warmed,
            "uncertainty": ended - searched,
        },
        notes=(*reading_notes(records), *clock_notes(errors)),
        **vars(judgement) | {"warnings": (*warned, *drive.warnings(), *judgement.warnings)},
    )


def asked_of(
    record: Record | Sequence[Record], robot: Robot | None, scenario: Scenario | None
) -> Asked:
    """Return the checked inputs of `identify`, which has the same arguments and errors."""
    given = [record] if isinstance(record, (xr.Dataset, str, PathLike)) else list(record)
    records = [one if isinstance(one, xr.Dataset) else _read(one) for one in given]
    if not records:
        raise EstimationError("no record to identify from")
    scenario = recorded_scenario(records[0]) if scenario is None else scenario
    _check_type(scenario, Scenario, "identify.load_scenario")
    of_file = robot is None
    if robot is None:
        loaded = robot_of_record(records[0], scenario.robot)
        robot = known_geometry(loaded, scenario.geometry).robot
    _check_type(robot, Robot, "dynamics.load_robot")
    side = model_side(robot, scenario)
    if of_file:
        warn_of_changed_robot(records[0], side.robot, scenario.robot)
    return Asked(records, side, scenario.identification)


def _read(record: object) -> xr.Dataset:
    if not isinstance(record, (str, PathLike)):
        raise EstimationError(
            f"{shown(record)} is neither a record (an xarray.Dataset) nor the path of its file"
        )
    return read(Path(record))


def _check_type(given: object, kind: type, loader: str) -> None:
    if not isinstance(given, kind):
        raise EstimationError(
            f"{shown(given)} is not a {kind.__name__}: {loader}(name or path) returns one"
        )


def output_error_problem(
    records: Sequence[xr.Dataset], side: ModelSide, settings: Identification
) -> OutputErrorProblem:
    """Return the output-error problem of one or several records.

    The scale anchor is read from the first record.

    Raises RecordError if the first record has no scale anchor, or a record has no measured poses.
    Raises EstimationError if a record is of another robot or is not suitable for an identification,
    if the first record has another timing or servo, or if the scale anchor is a payload and all
    records have the same load. Raises ScenarioError if there is no parameter set for the initial
    guess, or the guess is not valid for the model.
    """
    robot = side.robot
    # The motion depends only on the groups, so only their sensitivities are integrated.
    groups = structure(robot).rigid_groups
    # Further records can be of other days, with another timing or servo.
    sides = [side, *(side_of_record(side, record) for record in records[1:])]
    runs = tuple(
        replace(identified_model(record, own), groups=groups)
        for record, own in zip(records, sides, strict=True)
    )
    anchor = read_anchor(records[0], robot.layout)
    if anchor.name == "payload" and len({float(run.payload @ run.payload) for run in runs}) < 2:
        raise EstimationError(
            f"the scale anchor is a payload, but the {len(runs)} records all have the same load: "
            "a record with and a record without the load are needed"
        )
    guess = model_guess(robot, side.model, settings)
    try:
        checked_loop_parameters(robot, guess.values, side.model.drive_law)
    except DynamicsError as error:
        known = ", ".join(settings.prior) or "nothing"
        raise ScenarioError(
            f"no model can have the initial guess (set {side.model.start_parameters!r}, known "
            f"beforehand: {known}): {error}"
        ) from None
    return OutputErrorProblem(
        runs=runs,
        guess=guess,
        anchor=anchor,
        low_pass=side.low_pass,
        stop=StopCriteria(
            settings.cost_tolerance, settings.parameter_tolerance, settings.max_iterations
        ),
        physical=settings.physical_consistency,
    )
