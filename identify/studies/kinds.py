"""Which function computes a row: a built-in kind, or ``module:function`` of one's own.

A function of one's own takes the scenario, the row's ``numpy.random.SeedSequence`` and the options, and returns the
row's figures by name, units in the names. Workers import it, so it must be in a module that they find.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from identify.errors import ScenarioError, StudyError
from identify.scenario import Scenario
from identify.studies import rows

RowFunction = Callable[[Scenario, np.random.SeedSequence, Mapping[str, Any]], Mapping[str, float]]


def row_function(kind: str) -> RowFunction:
    """The function that computes a row of a kind.

    Raises:
        StudyError: no such kind, with the built-in ones, or no such module or function.
    """
    if ":" in kind:
        return _own(kind)
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


def check_kind(kind: str, options: Mapping[str, Any]) -> None:
    """Refuse a kind that does not exist, or options that it does not take.

    Raises:
        StudyError: with the valid names.
    """
    row_function(kind)
    if ":" not in kind:
        try:
            rows.check_options(kind, options)
        except ScenarioError as error:
            raise StudyError(str(error)) from error


def _own(kind: str) -> RowFunction:
    module, _, name = kind.partition(":")
    try:
        function: RowFunction = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise StudyError(
            f"kind {kind!r} is no importable module:function: {error}; its folder must be on PYTHONPATH"
        ) from error
    if not callable(function):
        raise StudyError(f"kind {kind!r} is not a function")
    return function
