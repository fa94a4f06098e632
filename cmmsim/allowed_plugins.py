"""Detectors and renderers by name: built-in ones, and a user's own as ``module:name``.

A built-in part is a file of its own and one line here. Its module is imported when its name is
first used.

``module:name`` may stand wherever a built-in name may. The module's folder must be on PYTHONPATH,
so that other processes find it. Scenarios, sensor files and studies are passed around, so a name in
them runs code only where its module is allowed: by ``--plugin my_module`` on the command line, in
the environment variable ``CMMSIM_PLUGINS``, or by `allow_plugin`.
"""

import importlib
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
    "statistical": "cmmsim.without_images.drawn_stickers:STATISTICAL",
}
AUTO = "auto"  # pyrender where OpenGL works, else analytic
ALLOWED = "CMMSIM_PLUGINS"  # modules, separated by commas; processes that are started inherit it


def allow_plugin(*modules: str) -> None:
    """Allow parts of these modules to run, in this process and in those that it starts.

    A package allows the modules within it, too.

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
        If no module can have a name.

    Examples
    --------
    >>> allow_plugin("my_detector")
    >>> "my_detector" in allowed_plugins()
    True
    """
    for module in modules:
        if not _is_module(module):
            raise CmmError(f"{module!r} is no name of a module, such as my_module")
    os.environ[ALLOWED] = ",".join(dict.fromkeys([*allowed_plugins(), *modules]))


def allowed_plugins() -> tuple[str, ...]:
    """Names of the modules whose parts may run."""
    names = os.environ.get(ALLOWED, "").split(",")
    return tuple(name.strip() for name in names if name.strip())


def is_own(name: str) -> bool:
    """Tell whether a name is ``module:name`` of a user's own."""
    return ":" in name


def own_part(option: str, name: str) -> Any:
    """Import the part of a user's own that ``module:name`` names.

    ``option`` is what the part is to be, for messages. Raises CmmError if the module is not allowed
    to run, cannot be imported, or has no such part.
    """
    module, _, attribute = name.partition(":")
    if not (_is_module(module) and attribute.isidentifier()):
        raise CmmError(f"{option} {name!r} is no module:name, such as my_module:my_part")
    # The dots keep "my_module" from allowing "my_module_2".
    if not any(f"{module}.".startswith(f"{allowed}.") for allowed in allowed_plugins()):
        raise CmmError(
            f"{option} {name!r} is code of the module {module}, which is not allowed to run; where "
            f"you trust it, add --plugin {module} to the command, set {ALLOWED}={module}, or call "
            f"cmmsim.allow_plugin({module!r}) in Python"
        )
    try:
        return getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:
        raise CmmError(
            f"{option} {name!r} is no importable module:name: {error}; its folder must be on "
            "PYTHONPATH"
        ) from error


@dataclass(frozen=True)
class Telling:
    """A user's own function. Its errors are reported in one line with their place in its file.

    ``part`` is its name in messages. ``refusal`` is the class of the error that is raised, and
    ``known`` are classes that pass unchanged. ``check`` is called with the part's name, the result
    and the arguments; it raises a known error where the result is not what it should be.
    """

    part: str
    function: Callable[..., Any]
    refusal: type[Exception]
    known: tuple[type[Exception], ...] = ()
    check: Callable[..., None] | None = None

    def __call__(self, *given: Any) -> Any:
        """Return what the function returns. Raises `refusal`, or a known error."""
        try:
            found = self.function(*given)
            if self.check is not None:
                self.check(self.part, found, *given)
            return found
        except self.known:
            raise
        except (Exception, SystemExit) as error:  # a part does not end the program
            # The first entry is the call above; the second, where there is one, is in the user's
            # file.
            at = traceback.extract_tb(error.__traceback__)[:2][-1]
            place = f"{Path(at.filename).name}, line {at.lineno}"
            said = f"{self.part} raised {type(error).__name__}: {error} ({place})"
            raise self.refusal(said) from error


def require_detector(name: str) -> str:
    """Return the name of a built-in detector or ``module:name``. Raises UnknownOptionError."""
    return _required("detector", name, DETECTORS)


def require_renderer(name: str) -> str:
    """Return the name of a built-in renderer, "auto" or ``module:name``. Raises
    UnknownOptionError.
    """
    return _required("renderer", name, {AUTO: "", **RENDERERS})


def find(
    option: str,
    name: str,
    built_in: Mapping[str, str],
    kind: type[K],
    check: Callable[..., None],
) -> K:
    """Return the Detector or Renderer, as ``kind`` says, of a built-in name or of ``module:name``.

    A user's own part may be an instance of the kind, a function, or a class that is made without
    arguments and called like the function. A function becomes an instance of the kind, with those
    of the kind's figures that it carries as attributes. ``check`` judges its results, see
    `Telling`.

    Raises UnknownOptionError with the valid names. Raises CmmError for a part that cannot be
    called, and for a module that is not allowed to run.
    """
    name = _required(option, name, built_in)
    if name in built_in:
        module, _, attribute = built_in[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    part = own_part(option, name)
    said = f"{option} {name!r}"
    found = Telling(said, part, CmmError)() if isinstance(part, type) else part
    # The kind's fields are its name, what it does, and figures with defaults.
    _, does, *figures = fields(kind)
    function = getattr(found, does.name) if isinstance(found, kind) else found
    if not callable(function):
        raise CmmError(f"{said} is of type {type(function).__name__}, which cannot be called")
    carried = [field for field in figures if hasattr(found, field.name)]
    values = {field.name: _figure(said, found, field) for field in carried}
    return kind(name, Telling(said, function, CmmError, (CmmError,), check), **values)


def _figure(part: str, owner: Any, field: Any) -> Any:
    """Return a figure that a user's own function carries, such as its ``bias_px``."""
    value = getattr(owner, field.name)
    kind = type(field.default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1000:
        raise CmmError(f"{part} has {field.name} = {value!r}, must be a number from 0 to 1000")
    return kind(value)


def _required(option: str, name: str, built_in: Mapping[str, str]) -> str:
    if not isinstance(name, str) or not (name in built_in or is_own(name)):
        raise UnknownOptionError(option, name, built_in, own=True)
    return name


def _is_module(name: object) -> bool:
    return isinstance(name, str) and all(part.isidentifier() for part in name.split("."))
