"""Changes to the entries of a sensor file, by dotted key as ``{"camera.dark_noise": 40.0}`` or nested as in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmmsim.errors import SensorFileError


def dotted(changes: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Changes by dotted key, whether given so or as tables in tables; a later one replaces an earlier one."""
    found: dict[str, Any] = {}
    for key, value in changes.items():
        path = f"{section}{key}"
        found |= dotted(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return found


def require_keys(name: str | Path, changes: object) -> None:
    """Raise SensorFileError for changes that are no tables with names for keys."""
    if changes is None:
        return
    if not isinstance(changes, Mapping):
        raise SensorFileError(
            f"sensor file {name}: changes = {changes!r} must be given by key, as {{'camera.dark_noise': 40.0}}"
        )
    for key, value in changes.items():
        if not isinstance(key, str):
            raise SensorFileError(
                f"sensor file {name}: key {key!r} of the changes is no name such as 'camera.dark_noise'"
            )
        if isinstance(value, Mapping):
            require_keys(name, value)


def change(content: dict[str, Any], changes: Mapping[str, Any], source: str) -> None:
    """Put changes in their places in a file's content; what is no key of it is found later, with the valid names.

    source: what the content is of, for messages. Raises SensorFileError for what no change can be.
    """
    for path, value in dotted(changes).items():
        if path == "based_on":
            raise SensorFileError(f"{source}: based_on = {value!r} cannot be changed; name another sensor")
        _replace(content, path, value, source)


def _replace(content: dict[str, Any], path: str, value: Any, source: str) -> None:
    *sections, key = path.split(".")
    for section in sections:
        content = content.setdefault(section, {})
        if not isinstance(content, dict):
            raise SensorFileError(f"{source}: {section!r} in {path!r} is a value, not a section")
    if isinstance(content.get(key), dict):
        raise SensorFileError(f"{source}: {path} = {value!r} is a section; its keys are {', '.join(content[key])}")
    content[key] = value
