"""Detectors and renderers by name: built in, or ``module:name`` of a user's own.

A built-in one is a file of its own and one line here; its module is imported when its name is first used. One of a
user's own is given by its module and its name in there wherever a built-in name would do: a function, a class that is
made without arguments and called like the function, or a ready ``Detector`` or ``Renderer``. Its folder must be on
PYTHONPATH, so that other processes find it, too.
"""

import importlib
from collections.abc import Mapping
from dataclasses import fields
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
    "statistical": "cmmsim.statistical.exposure:STATISTICAL",
}
AUTO = "auto"  # pyrender where OpenGL works, else analytic


def require_detector(name: str) -> str:
    """The name, which is that of a built-in detector or ``module:name``. Raises UnknownOptionError."""
    return _required("detector", name, DETECTORS)


def require_renderer(name: str) -> str:
    """The name, which is "auto", that of a built-in renderer or ``module:name``. Raises UnknownOptionError."""
    return _required("renderer", name, {AUTO: "", **RENDERERS})


def is_own(name: str) -> bool:
    """Whether a name is ``module:name`` of a user's own."""
    return ":" in name


def find(option: str, name: str, built_in: Mapping[str, str], kind: type[K]) -> K:
    """The Detector or Renderer, which ``kind`` says, of a built-in name or ``module:name``.

    A class of a user's own is made without arguments; what is called becomes one of the kind with that name, and with
    those of its figures that it carries itself. Raises UnknownOptionError with the valid names, and CmmError where
    there is no such module or nothing to be called.
    """
    module, _, attribute = built_in.get(_required(option, name, built_in), name).partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise CmmError(
            f"{option} {name!r} is no importable module:name: {error}; its folder must be on PYTHONPATH"
        ) from error
    found = found() if isinstance(found, type) else found
    if isinstance(found, kind):
        return found
    if not callable(found):
        raise CmmError(f"{option} {name!r} is of type {type(found).__name__}, which cannot be called")
    figures: list[Any] = [field for field in fields(kind)[2:] if hasattr(found, field.name)]
    return kind(name, found, **{field.name: type(field.default)(getattr(found, field.name)) for field in figures})


def _required(option: str, name: str, built_in: Mapping[str, str]) -> str:
    if not isinstance(name, str) or not (name in built_in or is_own(name)):
        raise UnknownOptionError(option, name, built_in, own=True)
    return name
