"""Known load on the platform during a run, which the record states.

A known load determines the scale of all parameters, if the same motion is made with and without it.
The load is a rigid body anywhere on the platform: a mass m with its centre of mass c in the frame
of the platform, and moments of inertia about c along the axes of the platform. It adds m, m c, and
its inertia about the origin of the frame to the inertial parameters of the platform. If c is not
the origin, the platform is a full body.

These seven figures, m, c and the three moments, describe the load. A record holds the
experimenter's values of the figures and their standard deviations. Records that state the same
figures were made with the same load.
"""

import numpy as np
import xarray as xr

from dynamics.parameters import ParameterLayout
from dynamics.pseudo_inertia import about_centre, full_body
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import as_number, shown
from identify.scenario.payload import FIGURES, check_load_std, check_moments

# Attributes of a record with the figures of a load. The standard deviation of each attribute has
# the same name with `_std` at the end.
ADDED = tuple(f"payload_{figure}" for figure in FIGURES)
CENTRE = slice(1, 4)  # indices of the centre of mass among the figures


def load_parameters(layout: ParameterLayout, figures: Array) -> Array:
    """Return the change (p,) of a robot's parameters by the figures (7,) of a load.

    Raises RecordError for a centre of mass off the origin if the platform is no full body.
    """
    return _of_platform(layout, full_body(figures[0], figures[CENTRE], np.diag(figures[4:])))


def load_errors(layout: ParameterLayout, figures: Array, std: Array) -> Array:
    """Return the changes (p, 7) of a robot's parameters by one standard deviation of each figure.

    The changes are of first order. Raises the RecordError of `load_parameters`.
    """
    mass, x, y, z = figures[:4]
    square = [y * y + z * z, x * x + z * z, x * x + y * y]
    slopes = np.zeros((7, 10))
    slopes[0] = [1, x, y, z, *square, -x * y, -x * z, -y * z]
    slopes[1] = [0, mass, 0, 0, 0, 2 * mass * x, 2 * mass * x, -mass * y, -mass * z, 0]
    slopes[2] = [0, 0, mass, 0, 2 * mass * y, 0, 2 * mass * y, -mass * x, 0, -mass * z]
    slopes[3] = [0, 0, 0, mass, 2 * mass * z, 2 * mass * z, 0, 0, -mass * x, -mass * y]
    slopes[range(4, 7), range(4, 7)] = 1.0
    return np.stack([_of_platform(layout, s * row) for s, row in zip(std, slopes, strict=True)], 1)


def _of_platform(layout: ParameterLayout, body: Array) -> Array:
    """Return the change (p,) of all parameters by a full body (10,) on the platform."""
    if not layout.full[0] and (body[1:4].any() or body[7:].any()):
        raise RecordError(
            "the load's centre of mass is not in the origin of the platform frame, but the "
            "platform is centred; a platform with first moments is a full body: "
            'model.inertia = { platform = "full" }'
        )
    bodies = np.zeros((len(layout.bodies), len(body)))
    bodies[0] = body
    added = np.zeros(len(layout.names))
    added[layout.inertial] = layout.rigid_of(bodies)
    return added


def payload_vector(
    layout: ParameterLayout,
    mass_kg: float,
    inertia_kg_m2: tuple[float, float, float],
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Array:
    """Return the change (p,) of a robot's parameters by a load.

    `inertia_kg_m2` are the moments about the load's centre of mass, and `centre_m` is this centre
    in the frame of the platform. For a load at the origin the change is linear in mass and moments.
    Given their standard deviations, the function then returns those of the change. Raises the
    RecordError of `load_parameters`.
    """
    return load_parameters(layout, np.array([mass_kg, *centre_m, *inertia_kg_m2], dtype=float))


def store_payload(
    record: xr.Dataset, layout: ParameterLayout, payload: Array, std: Array | None = None
) -> None:
    """Store a load (p,) with the record made under it.

    payload (p,): change of the parameters, as of `payload_vector`. std (p,): standard deviations of
    the load's mass and moments. If None, the load is known exactly. The centre counts as known
    exactly. `store_load` also stores a standard deviation of the centre.
    """
    deviations = np.zeros(len(layout.names)) if std is None else std
    body, body_std = (layout.bodies_of(one[layout.dynamic])[0] for one in (payload, deviations))
    centre, inertia = about_centre(body) if body[0] else (np.zeros(3), np.zeros((3, 3)))
    figures = np.array([body[0], *centre, *np.diagonal(inertia)])
    store_load(record, figures, np.array([body_std[0], 0.0, 0.0, 0.0, *body_std[4:7]]))


def store_load(record: xr.Dataset, figures: Array, std: Array) -> None:
    """Store the figures (7,) of a load and their standard deviations with a record."""
    for name, value, deviation in zip(ADDED, figures, std, strict=True):
        record.attrs |= {name: float(value), f"{name}_std": float(deviation)}


def recorded_payload(record: xr.Dataset, layout: ParameterLayout) -> tuple[Array, Array]:
    """Return the load (p,) of a record, and its `load_errors` (p, 7), zero without a load.

    Raises RecordError as `load_parameters` does, or if a figure is missing or not finite, a mass,
    moment or standard deviation is negative, no body has these moments, or a standard deviation
    exceeds its mass or moment.
    """
    count = len(layout.names)
    stated = record.attrs
    # A record that states one figure must state all of them, except the centre, which is at the
    # origin by default.
    if not any(name in stated or f"{name}_std" in stated for name in ADDED):
        return np.zeros(count), np.zeros((count, len(ADDED)))
    figures = np.zeros(len(ADDED))
    std = np.zeros(len(ADDED))
    try:
        for index, (name, (figure, unit)) in enumerate(zip(ADDED, FIGURES.items(), strict=True)):
            of_centre = figure in "xyz"
            value = stated.get(name, 0.0 if of_centre else None)
            figures[index] = _number(name, value, unit, least=-1e6 if of_centre else 0.0)
            std[index] = _number(f"{name}_std", stated.get(f"{name}_std", 0.0), unit)
            if not of_centre:
                check_load_std(f"{name}_std", std[index], name, figures[index], unit)
        check_moments({name: float(stated[name]) for name in ADDED[4:]})
    except ValueError as error:
        raise RecordError(f"the record's attribute {error}") from None
    return load_parameters(layout, figures), load_errors(layout, figures, std)


def _number(name: str, value: object, unit: str, least: float = 0.0) -> float:
    """Return an attribute's value, which must be a number from `least` to below 1e6."""
    number = as_number(value)
    if not least <= number < 1e6:
        raise RecordError(
            f"the record's attribute {name} is {shown(value)}, must be a number >= {least:g} and "
            f"< 1e6 in {unit}"
        )
    return number
