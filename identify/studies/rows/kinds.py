"""The kinds of row a study can have, built in or ``module:function`` of one's own, and what computes a row.

Which function computes a row: a built-in kind, or ``module:function`` of one's own.
A function of one's own is ``run(scenario, seed)`` or ``run(scenario, seed, options)``: it takes the scenario, the row's
``numpy.random.SeedSequence`` and, where the study has any, the options by name, and returns the row's figures by name,
units in the names. Workers import it, so it must be in a module that they find.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from identify.errors import ScenarioError, StudyError
from identify.plugins import is_own, own_function
from identify.scenario import Scenario
from identify.studies.rows.closed_loop import CLOSED_LOOP
from identify.studies.rows.columns import Column, Kind, Reads, Row
from identify.studies.rows.identification import IDENTIFICATION
from identify.studies.rows.path_pose import PATH_POSE
from identify.studies.rows.static_pose import STATIC_POSE

# The kinds of row a study can have, and the one pure function that computes a row.


KINDS: dict[str, Kind] = {kind.name: kind for kind in (STATIC_POSE, PATH_POSE, IDENTIFICATION, CLOSED_LOOP)}


def run(kind: str, scenario: Scenario, seed: np.random.SeedSequence, options: Mapping[str, Any]) -> Row:
    """One row: exactly the columns of its kind. The same arguments give the same row, whatever was computed before.

    Raises:
        ScenarioError: no such kind or option (with the valid names).
        IdentifyError, cmmsim.CmmError, dynamics.DynamicsError: what the row meets.
    """
    chosen = find_kind(kind)
    return chosen.compute(scenario, seed, chosen.checked(options))


def columns(kind: str) -> Mapping[str, Column]:
    """The figures of a kind with their units, in order. Raises ScenarioError for an unknown kind."""
    return find_kind(kind).columns


def check_options(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse unknown kinds and options before any row is computed. Raises ScenarioError with the valid names."""
    find_kind(kind).checked(options)


def find_kind(name: str) -> Kind:
    """The kind of that name. Raises ScenarioError with the valid names."""
    if name not in KINDS:
        raise ScenarioError(f"unknown kind of row {name!r}, valid are {', '.join(KINDS)}")
    return KINDS[name]


RowFunction = Callable[[Scenario, np.random.SeedSequence, Mapping[str, Any]], Mapping[str, float]]


def row_function(kind: str) -> RowFunction:
    """The function that computes a row of a kind.

    Raises:
        StudyError: no such kind, with the built-in ones; no such module or function, or one that takes other arguments.
    """
    if is_own(kind):
        function = own_function(kind, "kind", StudyError)
        if _takes_options(kind, function):
            return function
        return lambda scenario, seed, options: function(scenario, seed)
    options_model(kind)
    return lambda scenario, seed, options: run(kind, scenario, seed, options)


def options_model(kind: str) -> type[BaseModel] | None:
    """The model of a kind's options; None for a function of one's own, which takes any."""
    if is_own(kind):
        return None
    try:
        return find_kind(kind).options
    except ScenarioError as error:
        raise StudyError(f"{error}, or module:function") from error


def kind_reads(kind: str) -> Reads | None:
    """What a kind's rows read; None for a function of one's own, which reads what it likes."""
    return None if is_own(kind) else find_kind(kind).reads


def figure_names(kind: str) -> list[str] | None:
    """The figures of a kind's rows; None for a function of one's own, whose figures its rows tell.

    Raises:
        StudyError: no such kind.
    """
    options_model(kind)
    return None if is_own(kind) else list(columns(kind))


def check_kind(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse a kind that does not exist, or options that it does not take.

    Raises:
        StudyError: with the valid names.
    """
    row_function(kind)
    if is_own(kind):
        if options and not _takes_options(kind, own_function(kind, "kind", StudyError)):
            raise StudyError(
                f"kind {kind!r} takes no options, got {', '.join(options)}; a function that does is "
                "run(scenario, seed, options)"
            )
        return
    try:
        check_options(kind, options)
    except ScenarioError as error:
        raise StudyError(str(error)) from error


def _takes_options(kind: str, function: Callable[..., Any]) -> bool:
    """Whether a function takes three arguments, or two. Raises StudyError where it takes neither."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # written in C: it does not say
        return True
    for count in (3, 2):
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        return count == 3
    raise StudyError(
        f"kind {kind!r} takes {signature}; a row's function takes (scenario, seed) or (scenario, seed, options)"
    )
