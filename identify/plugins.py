"""What a user gives as ``module:function`` where a built-in name would do, found by importing it."""

import importlib
from collections.abc import Callable
from typing import Any, cast

from identify.errors import IdentifyError


def is_own(name: str) -> bool:
    """Whether a name is ``module:function`` and no built-in one."""
    return ":" in name


def own_function(name: str, what: str, error: type[IdentifyError]) -> Callable[..., Any]:
    """The function that ``module:function`` names; ``what`` it is to be, in messages: "kind", "estimator".

    Its folder must be on PYTHONPATH, so that workers on other machines find it, too.

    Raises:
        error: no such module or function, a module that cannot be imported, or something that cannot be called.
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
