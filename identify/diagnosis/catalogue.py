"""Catalogue of causes for which a model can miss its record: the built-in ones, and a user's own.

A user's own cause, ``module:function``, is a function (run, size) that takes the `LoopModel` of a
run without the cause, and returns the one with it. The function may carry a `unit` and, in that
unit, a `step` for differences.
"""

import math

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.diagnosis.body_causes import body_causes
from identify.diagnosis.cause import Cause, in_each_run
from identify.diagnosis.command_causes import command_causes
from identify.diagnosis.geometry_causes import geometry_causes
from identify.diagnosis.loop_causes import loop_causes
from identify.diagnosis.measurement_causes import measurement_causes
from identify.errors import EstimationError
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.own_parts import PluginFunction, own_function

STEP = 1e-4  # step of a user's own cause that carries none


def catalogue(problem: OutputErrorProblem, parameters: Array) -> tuple[Cause, ...]:
    """Return all causes that are possible for a problem with the optimum `parameters` (p,).

    Companions come after all other causes.
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


def own_cause(name: str) -> Cause:
    """Return a user's own cause. Raises EstimationError if the function or its step is unusable."""
    function = own_function(name, "cause", EstimationError)
    step = getattr(function, "step", STEP)
    if isinstance(step, bool) or not isinstance(step, int | float) or not 0 < step < math.inf:
        raise EstimationError(f"cause {name!r} has step = {step!r}, must be a number > 0")
    known = (EstimationError, DynamicsError)
    checked = PluginFunction(f"cause {name!r}", function, EstimationError, known, _check_run)
    return Cause(
        name=name,
        unit=str(getattr(function, "unit", "1")),
        group=name,
        change=in_each_run(checked),
        step=float(step),
        remedy=lambda size: f"see {name}",
    )


def _check_run(part: str, found: object, run: LoopModel, size: float) -> None:
    """Raise EstimationError unless a user's own cause returned a run with the same shapes."""
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
    """Raise EstimationError for a user's own cause whose column is not finite, or zero.

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
