"""The scale anchor: poses alone leave one common factor of all parameters free, and one measured value fixes it.

Multiplying every dynamic parameter and the three PID gains by the same number changes no pose of the closed loop
(eq. 17 and 31), so an experiment must bring one value from elsewhere: here the weighed mass of the platform.
"""

from dataclasses import dataclass

import xarray as xr

from identify.errors import RecordError, ScenarioError

ANCHORED_PARAMETER = {"platform_mass": "platform.mass"}
"""Anchors that an experiment can bring, and the parameter each measures."""

DEFAULT_STD = {"platform_mass": 0.005}
"""Standard deviation [kg] of an ordinary platform balance."""


@dataclass(frozen=True)
class ScaleAnchor:
    """A parameter measured on its own: its name, value and standard deviation, SI."""

    name: str
    parameter: str
    value: float
    std: float


def anchor_std(name: str, std: float | None) -> float:
    """Standard deviation of an anchor, the scenario's or the default.

    Raises:
        ScenarioError: no such anchor (with the valid names).
    """
    if name not in ANCHORED_PARAMETER:
        raise ScenarioError(
            f"unknown identification.scale_anchor {name!r}; valid: {', '.join(ANCHORED_PARAMETER)}"
        )
    return DEFAULT_STD[name] if std is None else std


def store_anchor(record: xr.Dataset, anchor: ScaleAnchor) -> None:
    """Keep the anchor's measurement with the record."""
    record.attrs |= {
        "scale_anchor": anchor.name,
        "scale_anchor_value": anchor.value,
        "scale_anchor_std": anchor.std,
    }


def read_anchor(record: xr.Dataset) -> ScaleAnchor:
    """The anchor's measurement of a record.

    Raises:
        RecordError: the record has none: the scale of its parameters is free.
    """
    name = record.attrs.get("scale_anchor")
    if name not in ANCHORED_PARAMETER or not float(record.attrs.get("scale_anchor_std", 0.0)) > 0:
        raise RecordError(
            f"the record holds no scale anchor (attributes scale_anchor, scale_anchor_value, scale_anchor_std), found "
            f"{name!r}; valid anchors: {', '.join(ANCHORED_PARAMETER)}"
        )
    value, std = float(record.attrs["scale_anchor_value"]), float(record.attrs["scale_anchor_std"])
    return ScaleAnchor(name, ANCHORED_PARAMETER[name], value, std)
