"""Diagnosis of records: the causes of the misfit that remains after an identification."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.diagnosis.asking import ask_first
from identify.diagnosis.catalogue import catalogue, check_columns
from identify.diagnosis.cause import Cause
from identify.diagnosis.diagnosis import Diagnosis, diagnosis_of
from identify.diagnosis.ranking import Rows
from identify.diagnosis.selection import select
from identify.errors import EstimationError
from identify.estimation.bounded_least_squares import AT_BOUND
from identify.estimation.identification import (
    Asked,
    Record,
    asked_of,
    identified,
    output_error_problem,
)
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.output_error_search import search_with_common_errors
from identify.estimation.result import IdentificationResult
from identify.progress import SilentProgress
from identify.runtime import one_thread
from identify.scenario import Scenario

MOST_STEPS = 30  # iterations after which the search under the logged commands ends


def diagnose(
    record: Record | Sequence[Record],
    result: IdentificationResult | None = None,
    robot: Robot | None = None,
    scenario: Scenario | None = None,
    causes: Sequence[Cause] = (),
) -> Diagnosis:
    """Name the causes for which the model of a robot misses its records, with their sizes.

    Parameters
    ----------
    record : xarray.Dataset or path, or sequence of them
        One or several records of the same robot, or the paths of their netCDF files.
    result : IdentificationResult, optional
        Result of the identification from these records, which is done here if none is given.
    robot : Robot, optional
        Robot as it is known. The default is the robot of the scenario.
    scenario : Scenario, optional
        Settings of the estimator. The default is the scenario that the first record carries.
    causes : sequence of Cause, optional
        Causes of one's own, beside those of the catalogue.

    Returns
    -------
    Diagnosis
        Causes in the order of their selection. There are none if chance explains the misfit.

    Raises
    ------
    RecordError, EstimationError, ScenarioError, dynamics.DynamicsError
        As `identify.identify`. An EstimationError also tells that a cause of one's own changes no
        pose or gives a model that does not run, or that the drives took torques.

    Examples
    --------
    >>> import identify
    >>> record = identify.run_experiment(identify.load_scenario("quick", renderer="statistical"))
    >>> identify.diagnose(record).findings
    ()
    """
    asked = asked_of(record, robot, scenario)
    return diagnosed(asked, result or identified(asked, SilentProgress()), causes)


def diagnosed(
    asked: Asked, result: IdentificationResult, causes: Sequence[Cause] = ()
) -> Diagnosis:
    """Return the same as `diagnose`, for checked inputs. Raises the same exceptions."""
    began = time.perf_counter()
    side = asked.side.with_drive(result.drive.law)
    problem = output_error_problem(asked.records, side, asked.settings)
    errors = result.common_errors.learned
    costs = dict(zip(result.searches, result.costs, strict=True))["command_driven"]
    # The final search has estimated common errors, which differ at the optimum under the commands.
    # Without them, this optimum is known unless its search reached the limit of iterations.
    settled = not errors and len(costs) <= asked.settings.max_iterations
    found = diagnosis_from(problem, result.driven_estimate, causes, errors, settled)
    return replace(found, seconds=time.perf_counter() - began)


@one_thread
def diagnosis_from(
    problem: OutputErrorProblem,
    start: Array,
    own: Sequence[Cause] = (),
    errors: Mapping[str, float] = MappingProxyType({}),
    settled: bool = False,
) -> Diagnosis:
    """Return the diagnosis of a problem, from parameters (p,) near its optimum.

    The joints are driven by the logged commands, since the residuals of a right model are white
    only then. own: causes in addition to those of the catalogue. errors: estimates of the first
    record's common errors, by name, from which their search starts. settled: whether the parameters
    are already the optimum under the logged commands.

    Raises EstimationError for a cause of one's own that has no effect or does not run, and for
    drives that took torques. Raises LoopFailure if the model is unstable.
    """
    began = time.perf_counter()
    if any(run.settings.drives.torques for run in problem.runs):
        raise EstimationError(
            "the drives took torques: a record is diagnosed only where they took joint commands"
        )
    problem = _with_errors(problem.driven_by_commands(), errors)
    if settled:
        bounds = problem.bounds
        coordinates = bounds.coordinates(start)
        scale = bounds.spread(coordinates, problem.guess.std)
        at_bound = coordinates <= bounds.lower + AT_BOUND * scale
    else:
        # Before convergence, causes would be blamed for misfit that the search has yet to remove.
        problem = replace(problem, stop=replace(problem.stop, max_iterations=MOST_STEPS))
        found = search_with_common_errors(problem, [start], lambda n=1: None)
        problem = found.linearised()
        start = found.solution.parameters
        at_bound = found.solution.at_bound
    causes = (*catalogue(problem, start), *own)
    point, first = ask_first(problem, start, at_bound, causes)
    check_columns(tuple(own), first.columns[:, len(causes) - len(own) :])
    selected = select(problem, point, causes, first)
    rows = Rows.of(problem, point.residual)
    return diagnosis_of(selected, causes, rows, time.perf_counter() - began)


def _with_errors(problem: OutputErrorProblem, errors: Mapping[str, float]) -> OutputErrorProblem:
    """Return a problem whose first run has these common errors.

    Other runs begin without errors, as theirs are not known. The problem is unchanged if there are
    no errors, or the first run has errors of other names.
    """
    first, *others = problem.runs
    if not errors or tuple(errors) != first.common.all_names:
        return problem
    drawn = np.linalg.pinv(first.common.whole_factor) @ np.array([*errors.values()])
    return replace(problem, runs=(first.having(drawn[: len(first.errors_had)]), *others))
