"""What a watch over the cameras' drift found during a run, beside its record."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from identify.errors import RecordError

DRIFT = "drift_watch"
"""Attribute of a record, and entry of `result.json`."""


def store_finding(record: xr.Dataset, finding: Mapping[str, Any]) -> None:
    """Keep a finding, as the sensor's drift watch gives it, with a record."""
    record.attrs[DRIFT] = json.dumps(dict(finding))


def read_finding(record: xr.Dataset) -> dict[str, Any] | None:
    """The finding that a record holds; None where nobody watched. Raises RecordError for what is
    none.
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
    """What the findings of records warn of. Raises RecordError."""
    findings = [read_finding(record) for record in records]
    return tuple(
        found["warning"] for found in findings if found is not None and found["warning"] is not None
    )
