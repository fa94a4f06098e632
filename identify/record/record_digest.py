"""A digest of records: equal where an identification reads the same, in whatever file and whenever it was written."""

import json
from hashlib import sha256

import numpy as np
import xarray as xr

from identify.files.digest import array_digest
from identify.record.payload import ADDED
from identify.record.recorded_origin import recorded_scenario
from identify.record.recorded_robot import ATTRIBUTE
from identify.record.recording import VARIABLES

STATED = (
    "robot", ATTRIBUTE, "seed", "frame_rate_hz", "scale_anchor", "scale_anchor_value", "scale_anchor_std",
    *ADDED, *(f"{name}_std" for name in ADDED),
)  # fmt: skip
"""Attributes that an identification reads; beside them timing and servo of the scenario."""


def record_digest(*records: xr.Dataset) -> str:
    """Digest of one or several records in their order, hexadecimal.

    Raises RecordError for a record that does not state its scenario.
    """
    whole = sha256()
    for record in records:
        arrays = {name: record[name].values for name in ("time", *VARIABLES)}
        stated = {name: _plain(record.attrs[name]) for name in STATED if name in record.attrs}
        scenario = recorded_scenario(record)
        stated |= {section: getattr(scenario, section).model_dump(mode="json") for section in ("timing", "servo")}
        whole.update(f"{array_digest(arrays)} {json.dumps(stated, sort_keys=True, default=str)}\n".encode())
    return whole.hexdigest()


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value
