"""Which function computes a row: a built-in kind, or ``module:function`` of one's own.

A function of one's own is ``run(scenario, seed)`` or ``run(scenario, seed, options)``: it takes the scenario, the row's
``numpy.random.SeedSequence`` and, where the study has any, the options by name, and returns the row's figures by name,
units in the names. Workers import it, so it must be in a module that they find.
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
from pydantic import BaseModel

from identify.errors import ScenarioError, StudyError
from identify.scenario import Scenario
from identify.studies.rows import rows
from identify.studies.rows.row_reads import Reads

RowFunction = Callable[[Scenario, np.random.SeedSequence, Mapping[str, Any]], Mapping[str, float]]


def row_function(kind: str) -> RowFunction:
    """The function that computes a row of a kind.

    Raises:
        StudyError: no such kind, with the built-in ones; no such module or function, or one that takes other arguments.
    """
    if ":" in kind:
        function = _own(kind)
        if _takes_options(kind, function):
            return function
        return lambda scenario, seed, options: function(scenario, seed)
    options_model(kind)
    return lambda scenario, seed, options: rows.run(kind, scenario, seed, options)


def options_model(kind: str) -> type[BaseModel] | None:
    """The model of a kind's options; None for a function of one's own, which takes any."""
    if ":" in kind:
        return None
    try:
        return rows.find_kind(kind).options
    except ScenarioError as error:
        raise StudyError(f"{error}, or module:function") from error


def kind_reads(kind: str) -> Reads | None:
    """What a kind's rows read; None for a function of one's own, which reads what it likes."""
    return None if ":" in kind else rows.find_kind(kind).reads


def figure_names(kind: str) -> list[str] | None:
    """The figures of a kind's rows; None for a function of one's own, whose figures its rows tell.

    Raises:
        StudyError: no such kind.
    """
    options_model(kind)
    return None if ":" in kind else list(rows.columns(kind))


def check_kind(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse a kind that does not exist, or options that it does not take.

    Raises:
        StudyError: with the valid names.
    """
    row_function(kind)
    if ":" in kind:
        if options and not _takes_options(kind, _own(kind)):
            raise StudyError(
                f"kind {kind!r} takes no options, got {', '.join(options)}; a function that does is "
                "run(scenario, seed, options)"
            )
        return
    try:
        rows.check_options(kind, options)
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


def _own(kind: str) -> Callable[..., Any]:
    module, _, name = kind.partition(":")
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise StudyError(
            f"kind {kind!r} is no importable module:function: {error}; its folder must be on PYTHONPATH"
        ) from error
    if not callable(function):
        raise StudyError(f"kind {kind!r} is not a function")
    return cast("Callable[..., Any]", function)
