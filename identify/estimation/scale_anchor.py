"""The scale anchor: poses alone leave one common factor of all parameters free, and something known
fixes it.

Multiplying every dynamic parameter and the three PID gains by the same number changes no pose of
the closed loop (eq. 17 and 31). What fixes the factor is one of

    platform_mass   the platform was weighed
    joint_gain      the proportional gain of the joint PID is known
    payload         a second run with a known load on the platform (`identify.record.payload`); the
                    standard deviations of the load stand with that run, and widen the intervals
                    (`load_error`)
    prior           nothing but the starting guess, with its standard deviations
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import as_number, shown

MEASURED_PARAMETER = {"platform_mass": "platform.mass", "joint_gain": "joint_pid.lp"}
"""Anchors that measure a parameter."""

ANCHORS = (*MEASURED_PARAMETER, "payload", "prior")

DEFAULT_STD = {"kg": 0.005, "N m/rad": 0.01, "N/m": 5.0}
"""Standard deviation of an ordinary platform balance [kg], and of a gain read from the controller's
data, by units.
"""


def default_std(name: str, layout: ParameterLayout) -> float:
    """Standard deviation [SI] of an ordinary instrument for what an anchor measures of a robot."""
    return DEFAULT_STD[layout.unit(MEASURED_PARAMETER[name])]


@dataclass(frozen=True)
class ScaleAnchor:
    """What fixes the scale; value and std (SI) where it is a parameter measured on its own, else
    None.
    """

    name: str
    value: float | None = None
    std: float | None = None

    def row(self, layout: ParameterLayout) -> tuple[Array, Array]:
        """What was measured as equations: rows (k, p) and right side (k,), in standard deviations;
        k is 0 or 1.
        """
        if self.value is None or self.std is None:
            return np.zeros((0, len(layout.names))), np.zeros(0)
        row = np.zeros((1, len(layout.names)))
        row[0, layout.names.index(MEASURED_PARAMETER[self.name])] = 1 / self.std
        return row, np.array([self.value / self.std])


def measured_anchor(
    name: str, std: float | None, layout: ParameterLayout, true: Array, rng: np.random.Generator
) -> ScaleAnchor:
    """The anchor as an experimenter with an instrument of standard deviation `std` (or the usual
    one) brings it, of a robot whose true parameters (p,) are `true`."""
    if name not in MEASURED_PARAMETER:
        return ScaleAnchor(name)
    spread = default_std(name, layout) if std is None else std
    measured = true[layout.names.index(MEASURED_PARAMETER[name])]
    return ScaleAnchor(name, float(measured + spread * rng.standard_normal()), spread)


def store_anchor(record: xr.Dataset, anchor: ScaleAnchor) -> None:
    """Keep the anchor's measurement with the record."""
    record.attrs["scale_anchor"] = anchor.name
    if anchor.value is not None and anchor.std is not None:
        record.attrs |= {"scale_anchor_value": anchor.value, "scale_anchor_std": anchor.std}


def read_anchor(record: xr.Dataset, layout: ParameterLayout) -> ScaleAnchor:
    """The anchor's measurement of a record of a robot.

    Raises RecordError: the record has none, so that the scale of its parameters is free; or a
    measured value or standard deviation that is no finite number > 0.
    """
    name = record.attrs.get("scale_anchor")
    if name not in ANCHORS:
        raise RecordError(
            "the record holds no scale anchor (attributes scale_anchor, scale_anchor_value, "
            "scale_anchor_std), found "
            f"{shown(name)}; valid anchors: {', '.join(ANCHORS)}"
        )
    if name not in MEASURED_PARAMETER:
        return ScaleAnchor(str(name))
    value, std = (_positive(record, f"scale_anchor_{what}", layout) for what in ("value", "std"))
    return ScaleAnchor(str(name), value, std)


def _positive(record: xr.Dataset, attribute: str, layout: ParameterLayout) -> float:
    """A record's attribute that must be a finite number > 0."""
    value = record.attrs.get(attribute)
    number = as_number(value)
    if not 0 < number < np.inf:
        anchor = record.attrs["scale_anchor"]
        measured = MEASURED_PARAMETER[anchor]
        raise RecordError(
            f"the record's attribute {attribute} is {shown(value)}, must be a finite number > 0 in "
            f"{layout.unit(measured)}: the scale anchor {anchor} measures {measured}"
        )
    return number
