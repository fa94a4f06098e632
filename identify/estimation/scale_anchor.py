"""Scale anchor: what fixes the common factor of all parameters, which poses alone leave free.

Multiplying every dynamic parameter and the three PID gains by the same number changes no pose of
the closed loop (eq. 17 and 31). The factor is fixed by one of

    platform_mass   the platform was weighed
    joint_gain      the proportional gain of the joint PID is known
    payload         a second run with a known load on the platform (`identify.record.payload`); the
                    standard deviations of the load stand with that run, and widen the intervals
                    (`covariance`)
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
"""Parameter that an anchor measures, by the anchor's name."""

ANCHORS = (*MEASURED_PARAMETER, "payload", "prior")

DEFAULT_STD = {"kg": 0.005, "N m/rad": 0.01, "N/m": 5.0}
"""Standard deviation of an ordinary instrument, by units.

It is that of a platform balance, kg, or of a gain read from the controller's data.
"""


def default_std(name: str, layout: ParameterLayout) -> float:
    """Return the standard deviation, SI, of an ordinary instrument for an anchor of a robot."""
    return DEFAULT_STD[layout.unit(MEASURED_PARAMETER[name])]


@dataclass(frozen=True)
class ScaleAnchor:
    """Measurement that fixes the scale.

    value and std are those of a parameter that was measured on its own, SI, or else None.
    """

    name: str
    value: float | None = None
    std: float | None = None

    def row(self, layout: ParameterLayout) -> tuple[Array, Array]:
        """Return the measurement as equations, in standard deviations.

        They are rows (k, p) and a right side (k,), with k = 0 if no parameter was measured, or else
        1.
        """
        if self.value is None or self.std is None:
            return np.zeros((0, len(layout.names))), np.zeros(0)
        row = np.zeros((1, len(layout.names)))
        row[0, layout.names.index(MEASURED_PARAMETER[self.name])] = 1 / self.std
        return row, np.array([self.value / self.std])


def measured_anchor(
    name: str, std: float | None, layout: ParameterLayout, true: Array, rng: np.random.Generator
) -> ScaleAnchor:
    """Return the anchor as an experimenter measures it.

    std: standard deviation of the instrument, None for the usual one. true (p,): true parameters of
    the robot.
    """
    if name not in MEASURED_PARAMETER:
        # nothing is measured here: a load stands with the run that was made under it
        return ScaleAnchor(name)
    spread = default_std(name, layout) if std is None else std
    measured = true[layout.names.index(MEASURED_PARAMETER[name])]
    return ScaleAnchor(name, float(measured + spread * rng.standard_normal()), spread)


def store_anchor(record: xr.Dataset, anchor: ScaleAnchor) -> None:
    """Store the anchor's measurement with the record."""
    record.attrs["scale_anchor"] = anchor.name
    if anchor.value is not None and anchor.std is not None:
        record.attrs |= {"scale_anchor_value": anchor.value, "scale_anchor_std": anchor.std}


def read_anchor(record: xr.Dataset, layout: ParameterLayout) -> ScaleAnchor:
    """Return the anchor's measurement of a robot's record.

    Raises RecordError if the record has none, so that the scale of its parameters is free, or if
    its value or standard deviation is no finite number > 0.
    """
    name = record.attrs.get("scale_anchor")
    if name not in ANCHORS:
        raise RecordError(
            "the record holds no scale anchor (attributes scale_anchor, scale_anchor_value, "
            f"scale_anchor_std), found {shown(name)}; valid anchors: {', '.join(ANCHORS)}"
        )
    if name not in MEASURED_PARAMETER:
        return ScaleAnchor(str(name))
    value, std = (_positive(record, f"scale_anchor_{what}", layout) for what in ("value", "std"))
    return ScaleAnchor(str(name), value, std)


def _positive(record: xr.Dataset, attribute: str, layout: ParameterLayout) -> float:
    """Return a record's attribute, which must be a finite number > 0."""
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
