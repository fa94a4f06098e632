"""Kinds of row that a study can have.

A built-in kind is one file here, and an entry in ``KINDS``. A user's own kind is named
``module:function``. The function is ``run(scenario, seed)`` or ``run(scenario, seed, options)``,
where ``seed`` is the row's ``numpy.random.SeedSequence``, and ``options`` is a dict of the row's
options by name. The function returns the figures of the row by name, with units in the names.
Workers must be able to import the module.
"""

import inspect
from collections.abc import Callable
from typing import Any

from identify.errors import StudyError
from identify.own_parts import is_plugin_name, own_function
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
    """Make a kind from a function of (scenario, seed, options), or of (scenario, seed)."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # functions written in C can lack a signature
        return Kind(name, function)
    for count in (3, 2):
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        if count == 3:
            return Kind(name, function)
        return Kind(name, lambda scenario, seed, _: function(scenario, seed), takes_options=False)
    raise StudyError(
        f"kind {name!r} takes {signature}; a row's function takes (scenario, seed) or (scenario, "
        "seed, options)"
    )
