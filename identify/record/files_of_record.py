"""Robot and sensor file of a record, and what has changed in them since it was made.

A scenario names these files by their paths. A record holds what an estimator knows of the robot
file, and the content of the sensor file. It does not hold the true robot.
"""

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import xarray as xr

from dynamics import Robot, load_robot
from dynamics.errors import RobotFileError
from dynamics.robot_file import RobotDescription, parsed_robot
from dynamics.robot_text import robot_text
from identify.files.dataset import shown

ROBOT_FILE = "robot_file"  # attribute with the text of a robot file, without the true robot
SENSOR_FILE = "sensor_file"  # attribute with the content of the sensor file, as JSON
ROUNDING = 1e-9  # largest relative difference of two numbers that counts as rounding


def store_robot_file(record: xr.Dataset, robot: Robot, start: str) -> None:
    """Store with a record what an estimator knows of the robot file.

    This includes no set of parameters but `guess` and the initial guess `start`. Meshes are left
    out, because they are other files.
    """
    known = ("guess", start)
    sets = {name: values for name, values in robot.parameter_sets.items() if name in known}
    geometry = replace(robot.geometry, meshes=())
    record.attrs[ROBOT_FILE] = robot_text(RobotDescription(robot.name, geometry, sets))


def robot_of_record(record: xr.Dataset, name_or_path: str) -> Robot:
    """Return the robot of a file or, if the file cannot be read, the robot that a record holds.

    Raises RobotFileError if the record holds no robot either. Warns if the record's robot is used.
    """
    try:
        return load_robot(name_or_path)
    except RobotFileError as error:
        if ROBOT_FILE not in record.attrs or Path(name_or_path).exists():
            raise
        warnings.warn(f"{error}: the robot that the record holds is used", stacklevel=3)
    return Robot(_held_robot(record))


def warn_of_changed_robot(record: xr.Dataset, robot: Robot, name_or_path: str) -> None:
    """Warn if a robot file states another guess or other errors than when a record was made.

    The geometry is compared by `check_robot`.
    """
    if ROBOT_FILE in record.attrs:
        held = _stated_numbers(_held_robot(record))
        ours = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
        warn_of_changes(f"robot file {name_or_path}", held, _stated_numbers(ours))


def warn_of_changed_sensor(record: xr.Dataset, content: str, name_or_path: str) -> None:
    """Warn if the content of a sensor file, as JSON, differs from that of a record."""
    if SENSOR_FILE in record.attrs:
        texts = (str(record.attrs[SENSOR_FILE]), content)
        held, ours = (_entries(json.loads(text)) for text in texts)
        warn_of_changes(f"sensor file {name_or_path}", held, ours)


def warn_of_changes(what: str, held: Mapping[str, object], ours: Mapping[str, object]) -> None:
    """Warn if entries of a file have changed since a record was made. New entries do not count.

    what  Name of the file in the message.
    held  Entries by name when the record was made.
    ours  Entries by name in the file as it is now.
    """
    changed = [
        f"{name} was {shown(value)} and is {shown(ours[name])}"
        for name, value in held.items()
        if name in ours and not _equal(value, ours[name])
    ]
    if changed:
        more = f", and {len(changed) - 1} more differ" if changed[1:] else ""
        warnings.warn(
            f"{what} has changed since the record was made: {changed[0]}{more}; the file is used "
            "as it is now",
            stacklevel=3,
        )


def _equal(one: object, other: object) -> bool:
    """Return whether two entries are equal, numbers up to rounding."""
    if isinstance(one, float) and isinstance(other, float | int):
        return abs(one - other) <= ROUNDING * abs(one)
    return one == other


def _entries(content: object, name: str = "") -> dict[str, object]:
    """Return the entries of nested tables and lists by their dotted names."""
    if isinstance(content, dict):
        pairs = [(f"{name}.{key}".lstrip("."), value) for key, value in content.items()]
    elif isinstance(content, list):
        pairs = [(f"{name}[{number}]", value) for number, value in enumerate(content, start=1)]
    else:
        return {name: content}
    return {key: value for part in pairs for key, value in _entries(part[1], part[0]).items()}


def _held_robot(record: xr.Dataset) -> RobotDescription:
    """Return the robot file that a record holds. Raises RobotFileError."""
    return parsed_robot(str(record.attrs[ROBOT_FILE]), f"the record's attribute {ROBOT_FILE}")


def _stated_numbers(robot: RobotDescription) -> dict[str, float]:
    """Return by name the errors of bodies and joints, and the values of all sets."""
    geometry = robot.geometry
    return {f"unstated.{name}": float(value) for name, value in geometry.unstated} | {
        f"{name} in parameters.{key}": float(value)
        for key, values in robot.parameter_sets.items()
        for name, value in zip(geometry.layout.names, values.vector, strict=True)
    }
