"""What can be chosen by name: the built-in ones are named here, a user's own is given as ``module:function``.

To build one in, write it in a file of its own and name it here as ``module:function``. Nothing is imported before it is
chosen, so that every room can look here.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, cast

from identify.errors import IdentifyError, ScenarioError

CRITERIA = {
    "observability": "identify.excitation.criteria:observability",
    "information": "identify.excitation.information:information",
}
"""Criteria of exciting trajectories, see `identify.excitation.criteria`."""

ESTIMATORS = {
    "closed_loop": "identify.estimators.output_error:closed_loop",
    "command_driven": "identify.estimators.output_error:command_driven",
    "known_pid": "identify.estimators.output_error:known_pid",
    "warm_start": "identify.estimators.output_error:warm_start_alone",
    "torque_ls": "identify.estimators.least_squares:least_squares",
    "torque_wls": "identify.estimators.least_squares:weighted_least_squares",
    "torque_iv": "identify.estimators.errors_in_variables:instrumental_variables",
    "torque_tls": "identify.estimators.errors_in_variables:total_least_squares",
    "encoders": "identify.estimators.least_squares:encoder_route",
}
"""Estimators that `cmmsim estimators` compares, in the order of its table, see `identify.estimators.estimator`."""


LAWS = {
    "pid": "dynamics.control.pid:pid",
    "feedforward": "dynamics.control.feedforward:feedforward",
    "computed_torque": "dynamics.control.computed_torque:computed_torque",
}
"""Laws that make a robot follow a motion, see `dynamics.control.law`."""


def check_choice(given: str, what: str, built_in: Mapping[str, str], error: type[Exception] = ScenarioError) -> None:
    """Refuse what is neither a built-in name nor ``module:function``. Raises `error` with the valid names."""
    if given not in built_in and not is_own(given):
        raise error(f"unknown {what} {given!r}; valid: {', '.join(built_in)}, or module:function")


def chosen(given: str, what: str, built_in: Mapping[str, str]) -> Callable[..., Any]:
    """What a built-in name stands for, or a user's own. Raises ScenarioError where there is none such."""
    check_choice(given, what, built_in)
    return own_function(built_in.get(given, given), what, ScenarioError)


def is_own(name: str) -> bool:
    """Whether a name is ``module:function`` and no built-in one."""
    return ":" in name


def own_function(name: str, what: str, error: type[IdentifyError]) -> Callable[..., Any]:
    """The function that ``module:function`` names; ``what`` it is to be, in messages: "kind", "estimator".

    Its folder must be on PYTHONPATH, so that workers on other machines find it, too.

    Raises error: no such module or function, a module that cannot be imported, or something that cannot be called.
    """
    module, _, attribute = name.partition(":")
    try:
        function = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as reason:
        raise error(
            f"{what} {name!r} is no importable module:function: {reason}; its folder must be on PYTHONPATH"
        ) from reason
    if not callable(function):
        raise error(f"{what} {name!r} is not a function")
    return cast("Callable[..., Any]", function)
