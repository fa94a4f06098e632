"""Catalogue of the causes for which a model may miss its record."""

from identify.arrays import Array
from identify.diagnosis.cause import Cause
from identify.diagnosis.command_causes import command_causes
from identify.diagnosis.geometry_causes import geometry_causes
from identify.diagnosis.measurement_causes import measurement_causes
from identify.estimation.output_error import OutputErrorProblem


def catalogue(problem: OutputErrorProblem, parameters: Array) -> tuple[Cause, ...]:
    """Return the causes that model and record can have, of a problem at its optimum (p,)."""
    return (
        *command_causes(problem),
        *geometry_causes(problem),
        *measurement_causes(problem, parameters),
    )
