"""The geometry of the robot that a record is of, kept with it: a name alone does not say which robot file was meant."""

import json
from dataclasses import fields
from typing import Any

import numpy as np
import xarray as xr

from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError, RecordError
from identify.files.attribute_text import shown

ATTRIBUTE = "robot_geometry"

ROUNDING = 1e-9
"""Largest difference of any number [SI] that another computer's arithmetic may make."""


def store_robot(record: xr.Dataset, robot: Robot) -> None:
    """Keep the geometry of the robot file with the record, as JSON."""
    record.attrs[ATTRIBUTE] = json.dumps(_numbers(robot))


def check_robot(record: xr.Dataset, robot: Robot) -> None:
    """The record must be of a robot of this name and, where it states one, of this geometry.

    Raises:
        EstimationError: another name, or the first number of the geometry that differs.
        RecordError: a geometry that cannot be read.
    """
    if record.attrs.get("robot") != robot.name:
        raise EstimationError(f"the record is of robot {shown(record.attrs.get('robot'))}, not of {robot.name!r}")
    if ATTRIBUTE not in record.attrs:
        return
    recorded = _read(record.attrs[ATTRIBUTE])
    for name, ours in _numbers(robot).items():
        theirs, known = recorded.get(name, np.zeros(0)), np.asarray(ours)
        if theirs.shape != known.shape:
            raise RecordError(f"{name} in the record's {ATTRIBUTE} has shape {theirs.shape}, expected {known.shape}")
        gap = np.abs(theirs - known)
        if not gap.max() <= ROUNDING:
            worst = np.unravel_index(int(np.argmax(gap)), gap.shape)
            place = "".join(f"[{k + 1}]" for k in worst)
            raise EstimationError(
                f"the record is of another robot {robot.name!r}: {name}{place} was {theirs[worst]:.9g} when it was "
                f"made, the robot file says {known[worst]:.9g}"
            )


def _numbers(robot: Robot) -> dict[str, Any]:
    geometry = robot.geometry
    return {field.name: np.asarray(getattr(geometry, field.name)).tolist() for field in fields(geometry)}


def _read(text: object) -> dict[str, Array]:
    try:
        return {name: np.asarray(values, dtype=float) for name, values in json.loads(str(text)).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise RecordError(f"the record's attribute {ATTRIBUTE} is no JSON object of numbers: {error}") from error
