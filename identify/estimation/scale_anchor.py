"""Scale anchor: the measurement that fixes the common factor of all parameters.

Multiplying all masses, inertias, friction and gains by one factor changes no pose of the closed
loop (eq. 17 and 31), so that poses alone do not determine this factor. One of these anchors does:

    platform_mass   the platform was weighed
    joint_gain      the proportional gain of the joint PID is known (that of the first joint, if
                    each joint has its own)
    payload         a second run with a known load on the platform (`identify.record.load`); the
                    record of that run states the standard deviations of the load, which widen the
                    intervals (`covariance`)
    prior           only the initial guess, with its standard deviations
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import as_number, shown

# Anchors that measure a parameter, see `measured_parameter`.
MEASURING = ("platform_mass", "joint_gain")

ANCHORS = (*MEASURING, "payload", "prior")


def measured_parameter(anchor: str, layout: ParameterLayout) -> str:
    """Return the name of the parameter that an anchor measures.

    If each joint has its own gains, the gain of the first joint is measured.
    """
    return {"platform_mass": "platform.mass", "joint_gain": layout.joint_pid_names[0]}[anchor]


# Standard deviation of an ordinary instrument, by the unit of the measured parameter. A balance
# measures the platform's mass. A gain comes from the data sheet of the controller.
DEFAULT_STD = {"kg": 0.005, "N m/rad": 0.01, "N/m": 5.0}


def default_std(name: str, layout: ParameterLayout) -> float:
    """Return the standard deviation, SI, of an ordinary instrument for an anchor of a robot."""
    return DEFAULT_STD[layout.unit(measured_parameter(name, layout))]


@dataclass(frozen=True)
class ScaleAnchor:
    """Measurement that fixes the scale.

    name: one of ANCHORS. value and std: measured value of a parameter and its standard deviation,
    SI. They are None if no parameter was measured.
    """

    name: str
    value: float | None = None
    std: float | None = None

    def row(self, layout: ParameterLayout) -> tuple[Array, Array]:
        """Return the measurement as k equations in the parameters, in standard deviations.

        They are returned as a matrix (k, p) and a right-hand side (k,). k is 1, or 0 if no
        parameter was measured.
        """
        if self.value is None or self.std is None:
            return np.zeros((0, len(layout.names))), np.zeros(0)
        row = np.zeros((1, len(layout.names)))
        row[0, layout.names.index(measured_parameter(self.name, layout))] = 1 / self.std
        return row, np.array([self.value / self.std])


def measured_anchor(
    name: str, std: float | None, layout: ParameterLayout, true: Array, rng: np.random.Generator
) -> ScaleAnchor:
    """Return the anchor of this name. If it is in MEASURING, it has a simulated measurement.

    std: standard deviation of the instrument, None for the default. true (p,): true parameters.
    """
    if name not in MEASURING:
        # These anchors have no measured parameter. The record under a load states the load.
        return ScaleAnchor(name)
    noise_std = default_std(name, layout) if std is None else std
    true_value = true[layout.names.index(measured_parameter(name, layout))]
    return ScaleAnchor(name, float(true_value + noise_std * rng.standard_normal()), noise_std)


def store_anchor(record: xr.Dataset, anchor: ScaleAnchor) -> None:
    """Store the anchor's measurement with the record."""
    record.attrs["scale_anchor"] = anchor.name
    if anchor.value is not None and anchor.std is not None:
        record.attrs |= {"scale_anchor_value": anchor.value, "scale_anchor_std": anchor.std}


def read_anchor(record: xr.Dataset, layout: ParameterLayout) -> ScaleAnchor:
    """Return the measurement of the scale anchor in a robot's record.

    Raises RecordError if the record has no valid anchor, or if the value or the standard deviation
    of an anchor in MEASURING is not a finite number > 0.
    """
    name = record.attrs.get("scale_anchor")
    if name not in ANCHORS:
        raise RecordError(
            "the record holds no scale anchor (attributes scale_anchor, scale_anchor_value, "
            f"scale_anchor_std), found {shown(name)}; valid anchors: {', '.join(ANCHORS)}"
        )
    if name not in MEASURING:
        return ScaleAnchor(str(name))
    value, std = (_positive(record, f"scale_anchor_{what}", layout) for what in ("value", "std"))
    return ScaleAnchor(str(name), value, std)


def _positive(record: xr.Dataset, attribute: str, layout: ParameterLayout) -> float:
    """Return a record's attribute, which must be a finite number > 0."""
    value = record.attrs.get(attribute)
    number = as_number(value)
    if not 0 < number < np.inf:
        anchor = record.attrs["scale_anchor"]
        measured = measured_parameter(anchor, layout)
        raise RecordError(
            f"the record's attribute {attribute} is {shown(value)}, must be a finite number > 0 in "
            f"{layout.unit(measured)}: the scale anchor {anchor} measures {measured}"
        )
    return number
