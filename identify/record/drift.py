"""Finding of a watch over the cameras' drift during a run, kept with its record."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from identify.errors import RecordError

DRIFT = "drift_watch"
"""Name of the attribute of a record, and of the entry of `result.json`."""


def store_finding(record: xr.Dataset, finding: Mapping[str, Any]) -> None:
    """Store a finding of the sensor's drift watch with a record."""
    record.attrs[DRIFT] = json.dumps(dict(finding))


def read_finding(record: xr.Dataset) -> dict[str, Any] | None:
    """Return the finding that a record holds, or None if nobody watched.

    Raises RecordError if the attribute is no finding.
    """
    if DRIFT not in record.attrs:
        return None
    try:
        finding = json.loads(record.attrs[DRIFT])
        _ = finding["warning"]
    except (TypeError, ValueError, KeyError) as error:
        raise RecordError(
            f"{DRIFT} of the record is no finding: {type(error).__name__} {error}"
        ) from None
    return dict(finding)


def drift_warnings(records: Sequence[xr.Dataset]) -> tuple[str, ...]:
    """Return the warnings in the findings of records. Raises RecordError as `read_finding`."""
    findings = [read_finding(record) for record in records]
    return tuple(
        found["warning"] for found in findings if found is not None and found["warning"] is not None
    )
