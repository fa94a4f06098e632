"""Diagnosis of records: the causes of the misfit that remains after an identification.

A user's own cause, ``module:function``, is a function (run, size) that returns the `LoopModel` of a
run with the cause, of the one without. The function may carry a `unit` and, in that unit, a `step`
for differences.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from dynamics import DynamicsError, Robot
from identify.arrays import Array
from identify.diagnosis.asking import ask_first
from identify.diagnosis.body_causes import body_causes
from identify.diagnosis.cause import Cause, in_each_run
from identify.diagnosis.command_causes import command_causes
from identify.diagnosis.diagnosis import Diagnosis, diagnosis_of
from identify.diagnosis.geometry_causes import geometry_causes
from identify.diagnosis.loop_causes import loop_causes
from identify.diagnosis.measurement_causes import measurement_causes
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
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import search_with_common_errors
from identify.estimation.result import IdentificationResult
from identify.model.loop_model import LoopModel
from identify.own_parts import PluginFunction, own_function
from identify.progress import SilentProgress
from identify.runtime import one_thread
from identify.scenario import Scenario

MOST_STEPS = 30  # largest number of steps of the search for the optimum under the logged commands


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
        What was identified from them. The default is to identify it.
    robot : Robot, optional
        Robot as it is known. The default is the robot of the scenario.
    scenario : Scenario, optional
        Settings of the estimator. The default is the scenario that the first record carries.
    causes : sequence of Cause, optional
        Causes of one's own, beside those of the catalogue.

    Returns
    -------
    Diagnosis
        Causes by their share of the misfit. A right model is accused of nothing.

    Raises
    ------
    RecordError, EstimationError, ScenarioError, dynamics.DynamicsError
        As `identify.identify`. An EstimationError also tells that a cause of one's own changes no
        pose, or that the drives took torques.

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
    # Common errors are those of the last search. The optimum of the model under commands then has
    # others, and must be searched.
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
    record's common errors, by name. The search for common errors starts from them. settled: whether
    the parameters are the optimum under the logged commands already.

    Raises EstimationError for a cause of one's own that has no effect, and for drives that took
    torques. Raises LoopFailure if the model is unstable.
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
    """Return a problem whose first run has these common errors, if it can have exactly these.

    Of other records nothing is known, and they begin without errors.
    """
    first, *others = problem.runs
    if not errors or tuple(errors) != first.common.all_names:
        return problem
    drawn = np.linalg.pinv(first.common.whole_factor) @ np.array([*errors.values()])
    return replace(problem, runs=(first.having(drawn[: len(first.errors_had)]), *others))


def catalogue(problem: OutputErrorProblem, parameters: Array) -> tuple[Cause, ...]:
    """Return all causes that are possible for a problem with the optimum `parameters` (p,).

    Companions of other causes come after all others.
    """
    runs = [run.simulate(parameters) for run in problem.runs]
    causes = (
        *command_causes(problem),
        *geometry_causes(problem),
        *loop_causes(problem, parameters, runs),
        *body_causes(problem, parameters, runs),
        *measurement_causes(problem, runs),
    )
    return (*causes, *(one.companion for one in causes if one.companion is not None))


STEP = 1e-4  # step of a cause that carries none


def own_cause(name: str) -> Cause:
    """Return a user's own cause. Raises EstimationError if it cannot be had."""
    function = own_function(name, "cause", EstimationError)
    step = getattr(function, "step", STEP)
    if isinstance(step, bool) or not isinstance(step, int | float) or not 0 < step < math.inf:
        raise EstimationError(f"cause {name!r} has step = {step!r}, must be a number > 0")
    known = (EstimationError, DynamicsError)
    told = PluginFunction(f"cause {name!r}", function, EstimationError, known, _check_run)
    return Cause(
        name=name,
        unit=str(getattr(function, "unit", "1")),
        group=name,
        change=in_each_run(told),
        step=float(step),
        remedy=lambda size: f"see {name}",
    )


def _check_run(part: str, found: object, run: LoopModel, size: float) -> None:
    """Raise EstimationError unless a user's own cause has returned a run with the same frames."""
    if not isinstance(found, LoopModel):
        raise EstimationError(f"{part} must return a LoopModel, returned {type(found).__name__}")
    for name in ("measured", "ok", "logged"):
        shape = np.shape(getattr(run, name))
        if np.shape(getattr(found, name)) != shape:
            raise EstimationError(
                f"{part} must keep the shape {shape} of {name}, returned "
                f"{np.shape(getattr(found, name))}"
            )


def check_columns(causes: tuple[Cause, ...], columns: Array) -> None:
    """Raise EstimationError for a user's own cause that has no column.

    columns (m, k): derivatives of the residuals with respect to the sizes of the causes.
    """
    for one, column in zip(causes, columns.T, strict=True):
        if not np.isfinite(column).all():
            raise EstimationError(
                f"cause {one.name!r} gives a model that does not run at sizes of ± {one.step:g}"
            )
        if not column.any():
            raise EstimationError(
                f"cause {one.name!r} changes no pose of the model at sizes of ± {one.step:g}"
            )
