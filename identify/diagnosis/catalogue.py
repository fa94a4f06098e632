"""Catalogue of the causes for which the model of a robot can miss its records."""

from identify.arrays import Array
from identify.diagnosis.body_causes import body_causes
from identify.diagnosis.cause import Cause
from identify.diagnosis.command_causes import command_causes
from identify.diagnosis.geometry_causes import geometry_causes
from identify.diagnosis.loop_causes import loop_causes
from identify.diagnosis.measurement_causes import measurement_causes
from identify.estimation.output_error import OutputErrorProblem


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
        *measurement_causes(problem, parameters),
    )
    return (*causes, *(one.companion for one in causes if one.companion is not None))
