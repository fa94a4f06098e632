"""Kinds of row that a study can have.

A built-in kind is one file here, and an entry in ``KINDS``. A user's own kind is named
``module:function``. The function is ``run(scenario, seed)`` or ``run(scenario, seed, options)``,
where ``seed`` is the row's ``numpy.random.SeedSequence``, and ``options`` is a dict of the row's
options by name. The function returns the figures of the row by name, with units in the names.
Workers must be able to import the module.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, SupportsFloat

import numpy as np

from cmmsim.errors import CmmError
from dynamics.errors import DynamicsError
from identify.errors import IdentifyError, StudyError
from identify.own_parts import PluginFunction, is_plugin_name, own_function
from identify.studies.rows.calibrated import CALIBRATION
from identify.studies.rows.closed_loop import CLOSED_LOOP
from identify.studies.rows.estimators import ESTIMATION
from identify.studies.rows.gauntlet.row import GAUNTLET
from identify.studies.rows.identified import IDENTIFICATION
from identify.studies.rows.kind import Kind
from identify.studies.rows.path_pose import PATH_POSE
from identify.studies.rows.static_pose import STATIC_POSE
from identify.studies.rows.tracking import TRACKING

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        STATIC_POSE,
        PATH_POSE,
        IDENTIFICATION,
        ESTIMATION,
        CLOSED_LOOP,
        TRACKING,
        GAUNTLET,
        CALIBRATION,
    )
}


def find_kind(name: str) -> Kind:
    """Return the kind of this name, built in or a user's own.

    Raises StudyError if there is no such kind (the message names the built-in kinds), module or
    function, or if the function has other arguments.
    """
    if is_plugin_name(name):
        return _own(name, own_function(name, "kind", StudyError))
    if name not in KINDS:
        raise StudyError(
            f"unknown kind of row {name!r}; valid: {', '.join(KINDS)}, or module:function"
        )
    return KINDS[name]


def _own(name: str, function: Callable[..., Any]) -> Kind:
    """Make a kind from a function of (scenario, seed, options), or of (scenario, seed).

    Errors of its rows name the function, and the file and line that raised an exception.
    """
    known = (CmmError, DynamicsError, IdentifyError)
    checked = PluginFunction(f"kind {name!r}", function, StudyError, known, _check_figures)
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # functions written in C can lack a signature
        return Kind(name, checked)
    for count in (3, 2):
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        if count == 3:
            return Kind(name, checked)
        return Kind(name, lambda scenario, seed, _: checked(scenario, seed), takes_options=False)
    raise StudyError(
        f"kind {name!r} takes {signature}; a row's function takes (scenario, seed) or (scenario, "
        "seed, options)"
    )


def _check_figures(part: str, row: object, *_: object) -> None:
    """Raise StudyError unless a user's function returned numbers by name."""
    if not isinstance(row, Mapping):
        raise StudyError(
            f"{part} must return its figures as a dict of numbers by name, returned "
            f"{type(row).__name__}"
        )
    for name, value in row.items():
        if not isinstance(name, str) or np.ndim(value) or not isinstance(value, SupportsFloat):
            raise StudyError(f"{part} must return a number as figure {name!r}, returned {value!r}")
