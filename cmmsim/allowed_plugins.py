"""Detectors and renderers by name: built-in ones, and a user's own as ``module:name``.

Each built-in detector or renderer has its own file, and one line in a table of this module. Its
file is imported when its name is first used.

``module:name`` can be used wherever a built-in name can be used. The module's folder must be on
PYTHONPATH, so that other processes find it. A file of another person must not run code unasked.
A module named in a scenario, sensor file or study is therefore imported only if it is allowed: by
``--plugin my_module`` on the command line, by the environment variable ``CMMSIM_PLUGINS``, or by
`allow_plugin`.
"""

import importlib
import inspect
import os
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from cmmsim.errors import CmmError, UnknownOptionError

K = TypeVar("K", bound=Any)  # Detector or Renderer
DETECTORS = {
    "maximum_likelihood": "cmmsim.detection.ellipse_fit:MAXIMUM_LIKELIHOOD",
    "dual_conic": "cmmsim.detection.dual_conic:DUAL_CONIC",
    "grey_centroid": "cmmsim.detection.grey_centroid:GREY_CENTROID",
}
DEFAULT_DETECTOR = "maximum_likelihood"
RENDERERS = {
    "analytic": "cmmsim.imaging.analytic:ANALYTIC",
    "pyrender": "cmmsim.imaging.pyrender_renderer:PYRENDER",
    "scene": "cmmsim.imaging.scene_renderer:SCENE",
    "mitsuba": "cmmsim.imaging.mitsuba_renderer:MITSUBA",
    "statistical": "cmmsim.without_images.drawn_stickers:STATISTICAL",
}
AUTO = "auto"  # pyrender where OpenGL works, else analytic
ALLOWED = "CMMSIM_PLUGINS"  # modules, separated by commas; child processes inherit the variable


def allow_plugin(*modules: str) -> None:
    """Allow the code of these modules to run, in this process and in processes that it starts.

    The name of a package allows all modules within it.

    Parameters
    ----------
    *modules : str
        Names of modules.

    Returns
    -------
    None

    Raises
    ------
    CmmError
        If a name is not a possible name of a module.

    Examples
    --------
    >>> allow_plugin("my_detector")
    >>> "my_detector" in allowed_plugins()
    True
    """
    for module in modules:
        if not _is_module(module):
            raise CmmError(f"{module!r} is not the name of a module, such as my_module")
    os.environ[ALLOWED] = ",".join(dict.fromkeys([*allowed_plugins(), *modules]))


def allowed_plugins() -> tuple[str, ...]:
    """Return the names of the modules whose code is allowed to run."""
    names = os.environ.get(ALLOWED, "").split(",")
    return tuple(name.strip() for name in names if name.strip())


def is_plugin_name(name: str) -> bool:
    """Return True if a name has the form ``module:name``, which names a user's own code."""
    return ":" in name


def import_plugin(option: str, name: str) -> Any:
    """Import a user's own object by its name ``module:name``, and return it.

    ``option`` is the kind of the object in messages, such as "detector". Raises CmmError if the
    module is not allowed to run, cannot be imported, or has no such object.
    """
    module, _, attribute = name.partition(":")
    if not (_is_module(module) and attribute.isidentifier()):
        raise CmmError(
            f"{option} {name!r} is not of the form module:name, such as my_module:my_part"
        )
    # The dots keep "my_module" from allowing "my_module_2".
    if not any(f"{module}.".startswith(f"{allowed}.") for allowed in allowed_plugins()):
        raise CmmError(
            f"{option} {name!r} is code of the module {module}, which is not allowed to run; if "
            f"you trust it, add --plugin {module} to the command, set {ALLOWED}={module}, or call "
            f"cmmsim.allow_plugin({module!r}) in Python"
        )
    try:
        imported = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        # The missing module can also be one that the user's module imports.
        missing = isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(
            f"{error.name}."
        )
        advice = "; the folder of the module must be on PYTHONPATH" if missing else ""
        raise CmmError(f"{option} {name!r} cannot be imported: {error}{advice}") from error
    if not hasattr(imported, attribute):
        names = ", ".join(
            own
            for own, value in vars(imported).items()
            if not own.startswith("_") and _can_be_part(value, module)
        )
        file = getattr(imported, "__file__", None)
        raise CmmError(
            f"{option} {name!r}: the module {file or module} has no {attribute}; it has "
            f"{names[:200] or 'nothing'}"
        )
    return getattr(imported, attribute)


def _can_be_part(value: object, module: str) -> bool:
    """Return True for functions and classes that a module defines, and for objects of a class.

    Imported functions, classes and modules are no parts, and neither are numbers and texts.
    """
    if inspect.isroutine(value) or inspect.isclass(value):
        return getattr(value, "__module__", None) == module
    return type(value).__module__ != "builtins"


@dataclass(frozen=True)
class PluginFunction:
    """Function of a plugin. Its exceptions are reported with file and line number.

    ``part`` is the function's name in messages. Exceptions of the classes ``known`` pass unchanged.
    Any other exception, and SystemExit, becomes an ``error_class``. ``check`` is called with
    ``part``, the result and the arguments. It raises an exception of a known class if the result is
    wrong.
    """

    part: str
    function: Callable[..., Any]
    error_class: type[Exception]
    known: tuple[type[Exception], ...] = ()
    check: Callable[..., None] | None = None

    def __call__(self, *given: Any) -> Any:
        """Return the function's result. Raises `error_class`, or an exception of a known class."""
        try:
            result = self.function(*given)
            if self.check is not None:
                self.check(self.part, result, *given)
            return result
        except self.known:
            raise
        except (Exception, SystemExit) as error:  # the user's function must not end the program
            # The first entry is the call above; the second, if it exists, is in the user's file.
            call = traceback.extract_tb(error.__traceback__)[:2][-1]
            line = f"{Path(call.filename).name}, line {call.lineno}"
            message = f"{self.part} raised {type(error).__name__}: {error} ({line})"
            raise self.error_class(message) from error


def require_detector(name: str) -> str:
    """Return the name of a detector.

    Raises UnknownOptionError unless it is built in or has the form ``module:name``.
    """
    return _required("detector", name, DETECTORS)


def require_renderer(name: str) -> str:
    """Return the name of a renderer.

    Raises UnknownOptionError unless it is built in, "auto", or has the form ``module:name``.
    """
    return _required("renderer", name, {AUTO: "", **RENDERERS})


def find(
    option: str,
    name: str,
    built_in: Mapping[str, str],
    kind: type[K],
    check: Callable[..., None],
) -> K:
    """Return the Detector or Renderer with a built-in name or a name ``module:name``.

    ``kind`` is the class Detector or Renderer. ``module:name`` can be an instance of ``kind``, a
    function, or a class whose instances are called like a function. Such a class is instantiated
    without arguments. A function is wrapped in an instance of ``kind``. If the function has an
    attribute with the name of a numeric field, such as ``bias_px``, the field gets its value.
    ``check`` checks each result, see `PluginFunction`.

    Raises UnknownOptionError, which lists the valid names, for an unknown name. Raises CmmError if
    a module is not allowed to run or cannot be imported, if its object is missing or cannot be
    called, or if a numeric attribute is out of range.
    """
    name = _required(option, name, built_in)
    if name in built_in:
        module, _, attribute = built_in[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    part = import_plugin(option, name)
    label = f"{option} {name!r}"
    own = PluginFunction(label, part, CmmError)() if isinstance(part, type) else part
    # The fields of a kind are its name, its function, and numbers with defaults.
    _, function_field, *number_fields = fields(kind)
    function = getattr(own, function_field.name) if isinstance(own, kind) else own
    if not callable(function):
        raise CmmError(f"{label} is of type {type(function).__name__}, which cannot be called")
    given = [field for field in number_fields if hasattr(own, field.name)]
    values = {field.name: _number(label, own, field) for field in given}
    return kind(name, PluginFunction(label, function, CmmError, (CmmError,), check), **values)


def _number(part: str, owner: Any, field: Any) -> Any:
    """Return a number that is an attribute of a user's own function, such as ``bias_px``.

    Raises CmmError unless it is at least 0 and below 1000.
    """
    value = getattr(owner, field.name)
    kind = type(field.default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1000:
        raise CmmError(
            f"{part} has {field.name} = {value!r}, must be a number of at least 0 and below 1000"
        )
    return kind(value)


def _required(option: str, name: str, built_in: Mapping[str, str]) -> str:
    """Return the name. Raises UnknownOptionError unless it is built in or ``module:name``."""
    if not isinstance(name, str) or not (name in built_in or is_plugin_name(name)):
        raise UnknownOptionError(option, name, built_in, own=True)
    return name


def _is_module(name: object) -> bool:
    """Return True if ``name`` is a possible name of a module, such as "package.module"."""
    return isinstance(name, str) and all(part.isidentifier() for part in name.split("."))
