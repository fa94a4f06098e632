"""Control law under which a record was made.

A model can close its own loop around the visual servo only. Of another law the record states the
name, and what its commands are: joint commands or, if the drives took them, torques. A record that
states nothing was made under the servo.
"""

import numpy as np
import xarray as xr

from dynamics.closed_loop import Drives
from identify.errors import RecordError

SERVO = "pid"
"""Name of the visual servo's law."""

TORQUE_UNITS = {"rad": "N m", "m": "N"}
"""Unit of commands that are torques, by that of joint commands."""


def store_law(record: xr.Dataset, law: str, drives: Drives) -> None:
    """Store with a record the law under which it was made, and what the drives took."""
    record.attrs |= {"law": law, "torque_commands": np.int8(drives.torques)}
    said = record["command"].attrs
    units = TORQUE_UNITS[said["units"]] if drives.torques else said["units"]
    what = "torque" if drives.torques else "joint command"
    said |= {"units": units, "long_name": f"{what} of the law {law} from this frame on"}


def recorded_law(record: xr.Dataset) -> str:
    """Return the name of a record's law. Raises RecordError if the attribute is no name."""
    law = record.attrs.get("law", SERVO)
    if not isinstance(law, str) or not law:
        raise RecordError(
            f"the record's attribute law is {law!r}, must be the name of the law, or absent for "
            "the servo"
        )
    return law


def takes_torques(record: xr.Dataset) -> bool:
    """Tell whether a record's commands are torques. Raises RecordError if it says neither."""
    said = record.attrs.get("torque_commands", 0)
    if said not in (0, 1):
        raise RecordError(f"the record's attribute torque_commands is {said!r}, must be 0 or 1")
    return bool(said)
