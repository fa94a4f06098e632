"""A known load on the platform: the same motion with and without it shows the scale of all parameters.

The load is a rigid body whose centre lies in the origin of the platform frame; it adds its mass and its principal
inertias to the platform's. Its figures stand with the record, as the experimenter's knowledge.
"""

import numpy as np
import xarray as xr

from identify.arrays import Array
from identify.errors import RecordError
from identify.estimation.loop_parameters import NAMES, index_of
from identify.scenario_checks import check_moments

ADDED = {
    "payload_mass": ("platform.mass", "kg"),
    "payload_Ixx": ("platform.Ixx", "kg m2"),
    "payload_Iyy": ("platform.Iyy", "kg m2"),
    "payload_Izz": ("platform.Izz", "kg m2"),
}
"""Attributes of a record, and the parameter and unit to which each adds."""


def payload_vector(mass_kg: float, inertia_kg_m2: tuple[float, float, float]) -> Array:
    """What a load adds to the parameters (67,)."""
    added = np.zeros(len(NAMES))
    for (parameter, _), value in zip(ADDED.values(), (mass_kg, *inertia_kg_m2), strict=True):
        added[index_of(parameter)] = value
    return added


def store_payload(record: xr.Dataset, payload: Array) -> None:
    """Keep a load (67,) with the record made under it."""
    record.attrs |= {name: float(payload[index_of(parameter)]) for name, (parameter, _) in ADDED.items()}


def recorded_payload(record: xr.Dataset) -> Array:
    """The load (67,) of a record; zero where it states none.

    Raises:
        RecordError: some but not all of its figures, one that is no finite number >= 0, or moments of no body.
    """
    given = [name for name in ADDED if name in record.attrs]
    if not given:
        return np.zeros(len(NAMES))
    added = np.zeros(len(NAMES))
    for name, (parameter, unit) in ADDED.items():
        value = record.attrs.get(name)
        if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number) or not 0 <= value < 1e6:
            raise RecordError(f"the record's attribute {name} is {value!r}, must be a number >= 0 in {unit}")
        added[index_of(parameter)] = float(value)
    try:
        check_moments({name: float(record.attrs[name]) for name in ADDED if name != "payload_mass"})
    except ValueError as error:
        raise RecordError(f"the record's attribute {error}") from None
    return added
