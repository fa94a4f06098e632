"""Known load on the platform, which shows the scale of all parameters.

The same motion is made with and without the load. The load is a rigid body whose centre lies in the
origin of the platform frame. It adds its mass and its principal moments of inertia to those of the
platform. A record holds these figures as the experimenter knows them, each with its standard
deviation, which says how well it was weighed or computed. Records that state the same figures carry
the same load.
"""

import numpy as np
import xarray as xr

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import as_number, shown
from identify.scenario.sections import check_load_std, check_moments

ADDED = {
    "payload_mass": ("platform.mass", "kg"),
    "payload_Ixx": ("platform.Ixx", "kg m2"),
    "payload_Iyy": ("platform.Iyy", "kg m2"),
    "payload_Izz": ("platform.Izz", "kg m2"),
}
"""Attributes of a record, with the parameter to which each adds, and its unit.

The standard deviation of `payload_mass` is `payload_mass_std`, and so for the others.
"""


def payload_vector(
    layout: ParameterLayout, mass_kg: float, inertia_kg_m2: tuple[float, float, float]
) -> Array:
    """Return what a load adds to a robot's parameters (p,).

    Given the standard deviations of its figures, it is the standard deviations of that.
    """
    added = np.zeros(len(layout.names))
    for (parameter, _), value in zip(ADDED.values(), (mass_kg, *inertia_kg_m2), strict=True):
        added[layout.names.index(parameter)] = value
    return added


def store_payload(
    record: xr.Dataset, layout: ParameterLayout, payload: Array, std: Array | None = None
) -> None:
    """Store a load (p,) with the record made under it.

    std (p,): standard deviations of the load. None: it is known exactly.
    """
    deviations = np.zeros(len(layout.names)) if std is None else std
    for name, (parameter, _) in ADDED.items():
        place = layout.names.index(parameter)
        record.attrs |= {name: float(payload[place]), f"{name}_std": float(deviations[place])}


def recorded_payload(record: xr.Dataset, layout: ParameterLayout) -> tuple[Array, Array]:
    """Return the load (p,) of a record and its standard deviations (p,), zero if it states none.

    Raises RecordError if a figure is missing, a figure or its standard deviation is no finite
    number >= 0, the moments are of no body, or a standard deviation exceeds its figure.
    """
    load = np.zeros(len(layout.names))
    std = np.zeros(len(layout.names))
    stated = record.attrs
    # a record that states one figure must state all
    if not any(name in stated or f"{name}_std" in stated for name in ADDED):
        return load, std
    try:
        for name, (parameter, unit) in ADDED.items():
            place = layout.names.index(parameter)
            load[place] = _not_negative(name, stated.get(name), unit)
            std[place] = _not_negative(f"{name}_std", stated.get(f"{name}_std", 0.0), unit)
            check_load_std(f"{name}_std", std[place], name, load[place], unit)
        check_moments({name: float(stated[name]) for name in ADDED if name != "payload_mass"})
    except ValueError as error:
        raise RecordError(f"the record's attribute {error}") from None
    return load, std


def _not_negative(name: str, value: object, unit: str) -> float:
    """Return an attribute's value, which must be a finite number >= 0."""
    number = as_number(value)
    if not 0 <= number < 1e6:
        raise RecordError(
            f"the record's attribute {name} is {shown(value)}, must be a number >= 0 in {unit}"
        )
    return number
