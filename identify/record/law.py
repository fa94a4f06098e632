"""Under which law a record was made: the visual servo, around which a model can close its own loop,
or another.

Of another law the record says its name, and what its commands are: joint commands or, where the
drives took them, torques. A record that says nothing was made under the servo.
"""

import numpy as np
import xarray as xr

from dynamics.closed_loop import Drives
from identify.errors import RecordError

SERVO = "pid"

TORQUE_UNITS = {"rad": "N m", "m": "N"}
"""Unit of commands that are torques, by that of joint commands."""


def store_law(record: xr.Dataset, law: str, drives: Drives) -> None:
    """Say in a record under which law it was made, and what the drives took."""
    record.attrs |= {"law": law, "torque_commands": np.int8(drives.torques)}
    said = record["command"].attrs
    units, what = (
        (TORQUE_UNITS[said["units"]], "torque")
        if drives.torques
        else (said["units"], "joint command")
    )
    said |= {"units": units, "long_name": f"{what} of the law {law} from this frame on"}


def recorded_law(record: xr.Dataset) -> str:
    """The name of the law. Raises RecordError for one that is no name."""
    law = record.attrs.get("law", SERVO)
    if not isinstance(law, str) or not law:
        raise RecordError(
            f"the record's attribute law is {law!r}, must be the name of the law, or absent for "
            "the servo"
        )
    return law


def takes_torques(record: xr.Dataset) -> bool:
    """Whether the commands of a record are torques. Raises RecordError for what says neither."""
    said = record.attrs.get("torque_commands", 0)
    if said not in (0, 1):
        raise RecordError(f"the record's attribute torque_commands is {said!r}, must be 0 or 1")
    return bool(said)
