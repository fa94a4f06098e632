"""Catalogue of the causes for which a model may miss its record."""

from identify.diagnosis.cause import Cause
from identify.diagnosis.command_causes import command_causes
from identify.diagnosis.geometry_causes import geometry_causes
from identify.estimation.output_error import OutputErrorProblem


def catalogue(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the causes that a problem's model and record can have."""
    return (*command_causes(problem), *geometry_causes(problem))
