"""Parts that can be chosen by name: built-in parts, and a user's own part as ``module:function``.

To build in a part, write it in a file of its own and add its ``module:function`` here. A part is
imported only when it is chosen, so every package can import this module. A user's own part runs
only if its module is allowed, see `cmmsim.allowed_plugins`.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, cast

from cmmsim.allowed_plugins import PluginFunction as PluginFunction
from cmmsim.allowed_plugins import import_plugin
from cmmsim.allowed_plugins import is_plugin_name as is_plugin_name
from cmmsim.errors import CmmError
from identify.errors import IdentifyError, ScenarioError

# Criteria of exciting trajectories, see `identify.excitation.criteria`.
CRITERIA = {
    "observability": "identify.excitation.criteria:observability",
    "information": "identify.excitation.information:information",
}

# Estimators that `cmmsim estimators` compares, in the order of its table. See
# `identify.estimators.estimator`.
ESTIMATORS = {
    "closed_loop": "identify.estimators.output_error_routes:closed_loop",
    "command_driven": "identify.estimators.output_error_routes:command_driven",
    "known_pid": "identify.estimators.output_error_routes:known_pid",
    "warm_start": "identify.estimators.output_error_routes:warm_start_alone",
    "torque_ls": "identify.estimators.least_squares:least_squares",
    "torque_wls": "identify.estimators.least_squares:weighted_least_squares",
    "torque_two_steps": "identify.estimators.least_squares:two_steps",
    "torque_iv": "identify.estimators.errors_in_variables:instrumental_variables",
    "torque_tls": "identify.estimators.errors_in_variables:total_least_squares",
    "encoders": "identify.estimators.least_squares:encoder_route",
}


# Laws that make a robot follow a motion, see `dynamics.control.law_interface`.
LAWS = {
    "pid": "dynamics.control.law_interface:pid",
    "feedforward": "dynamics.control.feedforward:feedforward",
    "computed_torque": "dynamics.control.computed_torque:computed_torque",
}


def check_choice(
    given: str,
    what: str,
    built_in: Mapping[str, str],
    error: type[Exception] = ScenarioError,
) -> None:
    """Refuse a name that is neither built in nor ``module:function``.

    what      Noun for the error message, such as "law".
    built_in  Built-in parts by name.
    error     Exception to be raised. Its message lists the valid names.
    """
    if given not in built_in and not is_plugin_name(given):
        raise error(f"unknown {what} {given!r}; valid: {', '.join(built_in)}, or module:function")


def chosen(given: str, what: str, built_in: Mapping[str, str]) -> Callable[..., Any]:
    """Return the built-in part with a name, or a user's own part.

    For the arguments see `check_choice`. Raises ScenarioError if there is no such part, or for the
    reasons that `own_function` states.
    """
    check_choice(given, what, built_in)
    if given not in built_in:
        return own_function(given, what, ScenarioError)
    module, _, attribute = built_in[given].partition(":")
    return cast("Callable[..., Any]", getattr(importlib.import_module(module), attribute))


def own_function(name: str, what: str, error: type[IdentifyError]) -> Callable[..., Any]:
    """Return the function that ``module:function`` names.

    name   ``module:function``.
    what   Noun for the error message, such as "kind" or "estimator".
    error  Exception to be raised.

    Raises `error` if the module is not allowed to run (the message states how to allow it), the
    module cannot be imported, or it has no such function.
    """
    try:
        function = import_plugin(what, name)
    except CmmError as failure:
        raise error(str(failure)) from failure
    if not callable(function):
        raise error(f"{what} {name!r} is not a function")
    return cast("Callable[..., Any]", function)
