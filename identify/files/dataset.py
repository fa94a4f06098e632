"""Described xarray datasets over time: every variable has dimensions, a unit and a name, and is checked for them."""

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from identify.arrays import Array
from identify.errors import RecordError

Variables = dict[str, tuple[tuple[str, ...], str, str]]
"""Dimensions, unit and description of each variable."""

AXIS = ["x", "y", "z"]
ANGLE = ["alpha", "beta", "gamma"]
POSE = AXIS + ANGLE
JOINT = [1, 2, 3, 4, 5, 6]

COORDINATES = {
    "time": ("s", "time since the start of the run"),
    "axis": ("", "position component"),
    "angle": ("", "Euler angle"),
    "joint": ("", "joint number"),
    "pose_component": ("", "pose component"),
    "pose_component_2": ("", "pose component"),
}
LABELS: dict[str, list[Any]] = {
    "axis": AXIS,
    "angle": ANGLE,
    "joint": JOINT,
    "pose_component": POSE,
    "pose_component_2": POSE,
}


def pose_array(values: ArrayLike, name: str) -> Array:
    """Array (N, 6) of floats.

    Raises:
        RecordError: another shape.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != 6:
        raise RecordError(f"{name} has shape {array.shape}, expected (N, 6)")
    return array


def described_dataset(values: dict[str, Any], time: ArrayLike, variables: Variables, **labels: list[str]) -> xr.Dataset:
    """Dataset of described variables on a time axis; ``labels`` are the coordinates of further dimensions.

    Raises:
        RecordError: an array whose shape does not fit its dimensions.
    """
    coordinates: dict[str, Any] = {"time": np.asarray(time, dtype=float), **LABELS, **labels}
    used = {dim for dims, _, _ in variables.values() for dim in dims}
    for name, (dims, _, _) in variables.items():
        expected = tuple(len(coordinates[dim]) for dim in dims)
        if np.shape(values[name]) != expected:
            raise RecordError(f"{name} has shape {np.shape(values[name])}, expected {dims} = {expected}")
    return xr.Dataset(
        {
            name: (dims, values[name], {"units": unit, "long_name": text})
            for name, (dims, unit, text) in variables.items()
        },
        coords={dim: (dim, coordinates[dim], _description(dim)) for dim in coordinates if dim in used},
    )


def check_variables(data: xr.Dataset, variables: Variables, source: str) -> None:
    """Refuse a dataset that lacks one of the variables, or has it on other dimensions.

    Raises:
        RecordError: naming what is missing or wrong.
    """
    missing = [name for name in variables if name not in data]
    if missing:
        raise RecordError(f"{source} lacks {', '.join(missing)}")
    for name, (dims, _, _) in variables.items():
        if data[name].dims != dims:
            raise RecordError(f"{source}: {name} has dimensions {data[name].dims}, expected {dims}")
        expected = [len(LABELS[dim]) if dim in LABELS else data[name].sizes[dim] for dim in dims]
        if list(data[name].shape) != expected:
            raise RecordError(f"{source}: {name} has shape {data[name].shape}, expected {tuple(expected)}")
    if "time" in data.dims and ("time" not in data.coords or data.sizes["time"] == 0):
        raise RecordError(f"{source} has no time")


def check_finite(values: Array, name: str, source: str) -> None:
    """Refuse values that are not finite.

    Raises:
        RecordError: naming the variable and how many of its values are wrong.
    """
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise RecordError(f"{source}: {bad} of {values.size} values of {name} are not finite numbers")


def _description(dim: str) -> dict[str, str]:
    unit, text = COORDINATES.get(dim, ("", dim))
    return {"units": unit, "long_name": text} if unit else {"long_name": text}
