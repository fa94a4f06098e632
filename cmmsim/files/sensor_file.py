"""Reading of sensor files (TOML), by name or path, with changes.

Changes are entries that replace entries of the file. They have dotted keys, as
``{"camera.dark_noise": 40.0}``, or are nested like the tables of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim.checks import checked, parsed, read_text, require_kind
from cmmsim.errors import SensorFileError, UnknownSensorError
from cmmsim.files.body_meshes import with_meshes
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array

BODIES = ("platform", "base")  # tables of the bodies that carry stickers


def dotted(changes: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Return changes with dotted keys, from changes with dotted keys or nested tables.

    A later change replaces an earlier change of the same key.
    """
    flat: dict[str, Any] = {}
    for key, value in changes.items():
        path = f"{section}{key}"
        flat |= dotted(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return flat


def require_keys(name: str | Path, changes: object) -> None:
    """Raise SensorFileError unless changes are mappings with text keys, or None."""
    if changes is None:
        return
    if not isinstance(changes, Mapping):
        raise SensorFileError(
            f"sensor file {name}: changes = {changes!r} must be a mapping of keys to values, as "
            "{'camera.dark_noise': 40.0}"
        )
    for key, value in changes.items():
        if not isinstance(key, str):
            raise SensorFileError(
                f"sensor file {name}: key {key!r} of the changes is not a text such as "
                "'camera.dark_noise'"
            )
        if isinstance(value, Mapping):
            require_keys(name, value)


def change(content: dict[str, Any], changes: Mapping[str, Any], source: str) -> None:
    """Apply changes to the content of a file, in place.

    Unknown keys are accepted here; the schema refuses them later. ``source`` names the content in
    messages. Raises SensorFileError for a change of ``based_on``, and if a change treats a section
    as a value or a value as a section.
    """
    for path, value in dotted(changes).items():
        if path == "based_on":
            raise SensorFileError(
                f"{source}: based_on = {value!r} cannot be changed; name another sensor"
            )
        _replace(content, path, value, source)


def _replace(content: dict[str, Any], path: str, value: Any, source: str) -> None:
    """Replace the entry with a dotted key. See ``change`` for the arguments and the errors."""
    *sections, key = path.split(".")
    for section in sections:
        content = content.setdefault(section, {})
        if not isinstance(content, dict):
            raise SensorFileError(f"{source}: {section!r} in {path!r} is a value, not a section")
    if isinstance(content.get(key), dict):
        raise SensorFileError(
            f"{source}: {path} = {value!r} is a section; its keys are {', '.join(content[key])}"
        )
    content[key] = value


def ring_of_stickers(listed: Sequence[tuple[float, float]], count: int) -> Array:
    """Return positions (count, 2) [u, v], m, on the one-sigma ellipse of listed positions.

    ``listed`` (n, 2) are the listed positions. Three or more points at equal angles on an ellipse
    have the same mean and the same covariance, whatever their number. The accuracy of a plane or a
    pose then depends on the number alone, and improves with its square root.
    """
    positions = np.asarray(listed, dtype=float)
    root = np.linalg.cholesky(np.cov(positions.T, bias=True))
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.asarray(
        positions.mean(axis=0) + np.column_stack([np.cos(angle), np.sin(angle)]) @ root.T,
        dtype=float,
    )


def closest(places: Array) -> float:
    """Return the smallest distance between neighbours on a ring of positions (n, 2), m."""
    return float(np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1).min())


def built_in_names() -> list[str]:
    """Return the names of the sensors that are part of the package.

    Returns
    -------
    list of str

    Examples
    --------
    >>> "ctrack780" in built_in_names()
    True
    """
    return sorted(
        f.name[:-5]
        for f in resources.files(__package__).joinpath("sensors").iterdir()
        if f.name.endswith(".toml")
    )


def sensor_text(name: str | Path) -> str:
    """Return the text of the sensor file with a built-in name or a path.

    Raises UnknownSensorError for a name that is neither, SensorFileError for a file that cannot be
    read, and CmmError if ``name`` is neither a text nor a path.
    """
    require_kind(
        name, (str, PathLike), "a sensor must be a built-in name or the path of a TOML file"
    )
    if str(name) in built_in_names():
        return (
            resources.files(__package__)
            .joinpath("sensors", f"{name}.toml")
            .read_text(encoding="utf-8")
        )
    try:
        is_file = Path(name).is_file()
    except OSError as error:  # such as a name that is too long
        raise SensorFileError(
            f"cannot read sensor file {str(name)[:200]}: {error.strerror or error}"
        ) from error
    if not is_file:
        raise UnknownSensorError(str(name), built_in_names())
    return read_text(name, f"sensor file {name}", SensorFileError)


def read_sensor_file(name: str | Path, changes: Mapping[str, Any] | None = None) -> SensorFile:
    """Read the sensor file with a built-in name or a path.

    Changes replace entries of the file. Raises UnknownSensorError for a name that is neither, and
    SensorFileError for wrong content. For an unknown key, the message lists the valid keys.
    """
    require_keys(name, changes)
    source = f"sensor file {name}" + (f" with changes to {', '.join(changes)}" if changes else "")
    content = _content(name)
    change(content, changes or {}, source)
    _refuse_idle_noise(changes or {}, content, source)
    camera = content.get("camera")
    if isinstance(camera, dict) and "grey_noise_percent" in camera:
        # The schema computes dark_noise from the percentage, which a complete file can state alone.
        camera.setdefault("dark_noise", 0.0)
    file = _with_stickers(checked(SensorFile, content, source, SensorFileError), source)
    return with_meshes(file, source)


def _refuse_idle_noise(
    statements: Mapping[str, Any], content: Mapping[str, Any], source: str
) -> None:
    """Raise SensorFileError if statements of ``dark_noise`` have no effect.

    ``content`` is the content of a file with the statements. Its ``grey_noise_percent`` replaces
    every ``dark_noise``, also one that is stated later.
    """
    stated = dotted(statements).get("camera.dark_noise")
    percent = dotted(content).get("camera.grey_noise_percent")
    if stated is not None and percent is not None:
        raise SensorFileError(
            f"{source}: camera.dark_noise = {stated} does nothing beside camera.grey_noise_percent "
            f"= {percent}, which replaces it; state and vary only one of them"
        )


def sensor_schema() -> dict[str, Any]:
    """Return the JSON schema of sensor files, which `sensors/sensor.schema.json` contains.

    In a file with ``based_on``, tables and entries are optional.
    """
    schema = SensorFile.model_json_schema()
    tables = {
        name: one["$ref"].rpartition("/")[2]
        for name, one in schema["properties"].items()
        if "$ref" in one
    }
    needed = {name: schema["$defs"][table].pop("required", []) for name, table in tables.items()}
    # In place of `dark_noise`, a file can state `grey_noise_percent`.
    needed["camera"].remove("dark_noise")
    complete: dict[str, Any] = {
        "required": schema["required"],
        "properties": {name: {"required": entries} for name, entries in needed.items() if entries},
    }
    names, of_plane = (
        schema["$defs"][table].pop("required") for table in ("Planes", "StickerPlane")
    )
    planes = {"required": names, "properties": {name: {"required": of_plane} for name in names}}
    for body in BODIES:
        complete["properties"][body]["properties"] = {"planes": planes}
    return schema | {
        "required": ["name"],
        "if": {"not": {"required": ["based_on"]}},
        "then": complete,
    }


def _with_stickers(file: SensorFile, source: str) -> SensorFile:
    """Return the file with ``stickers.per_plane`` stickers on each plane of the platform."""
    count = file.stickers.per_plane
    ring_width = 2.0 * file.stickers.ring_radius
    if count is None:
        return file
    planes = {}
    for name, plane in file.platform.planes:
        places = ring_of_stickers(plane.stickers, count)
        if closest(places) < ring_width:
            raise SensorFileError(
                f"{source}: with stickers.per_plane = {count}, stickers on plane {name} are "
                f"{closest(places):.4f} m apart, but their rings need {ring_width:g} m"
            )
        planes[name] = plane.model_copy(update={"stickers": [(u, v) for u, v in places.tolist()]})
    platform = file.platform.model_copy(
        update={"planes": file.platform.planes.model_copy(update=planes)}
    )
    return file.model_copy(update={"platform": platform})


def _content(name: str | Path) -> dict[str, Any]:
    """Return the content of a file, completed from the sensor that ``based_on`` names.

    Missing tables, and missing entries of a table, are added. Of the tables within tables, only the
    planes of stickers are completed too.
    Raises SensorFileError if only the cameras are described, or for a wrong ``based_on``.
    """
    own = _table(name)
    if own.keys() == {"rig"}:
        beside = Path(name).parent / "sensor.toml"
        whole = f"{beside} is" if beside.is_file() else "cmmsim calibrate --sensor NAME writes"
        raise SensorFileError(
            f"sensor file {name} has only the table of the cameras; {whole} the whole file"
        )
    basis = own.get("based_on")
    if not isinstance(basis, str):
        _refuse_idle_noise(own, own, f"sensor file {name}")
        return own
    basis_file = basis if basis in built_in_names() else Path(name).parent / basis
    try:
        base = _table(basis_file)
    except UnknownSensorError as error:
        raise SensorFileError(f"sensor file {name}: based_on: {error}") from error
    if "based_on" in base:
        raise SensorFileError(
            f"sensor file {name}: based_on = {basis!r} is itself based on {base['based_on']!r}: "
            "name a sensor with a complete file"
        )
    merged = {
        key: {**base[key], **value}
        if isinstance(value, dict) and isinstance(base.get(key), dict)
        else value
        for key, value in own.items()
    }
    for body in BODIES:
        _complete_planes(merged.get(body), base.get(body))
    _refuse_idle_noise(base, base, f"sensor file {basis_file}")
    _refuse_idle_noise(own, base | merged, f"sensor file {name}")
    return base | merged


def _complete_planes(body: Any, basis: Any) -> None:
    """Add missing planes of stickers, and missing entries of a plane, from another body."""
    own, others = (one.get("planes") if isinstance(one, dict) else None for one in (body, basis))
    if isinstance(own, dict) and isinstance(others, dict):
        body["planes"] = others | {
            name: {**others[name], **plane}
            if isinstance(plane, dict) and isinstance(others.get(name), dict)
            else plane
            for name, plane in own.items()
        }


def _table(name: str | Path) -> dict[str, Any]:
    """Return the content of a file, in which the paths of meshes are absolute."""
    content = parsed(sensor_text(name), f"sensor file {name}", SensorFileError)
    for body in BODIES:
        section = content.get(body)
        if isinstance(section, dict) and isinstance(section.get("mesh"), str):
            section["mesh"] = str(Path(name).resolve().parent / section["mesh"])
    return content
