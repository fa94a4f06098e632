"""Datasets of described variables over time, and covariances, in groups of netCDF files.

Files are written completely or not at all. Dimensions, shapes and names are checked. The file
`covariance.nc` has the covariance of the estimated parameters and common errors, in SI units.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.atomic import write_bytes
from identify.files.digest import has_digest, with_digest
from identify.files.limited_process import UntrustedFileError
from identify.files.untrusted import ENGINE, Content, load, load_in_process


def write_groups(path: Path | str, groups: Mapping[str, xr.Dataset]) -> None:
    """Write datasets as groups of one file (see `netcdf`), or raise WriteError."""
    write_bytes(path, netcdf(groups))


def netcdf(groups: Mapping[str, xr.Dataset]) -> bytes:
    """Return the content of a file with datasets, which are given by the names of their groups.

    The name ``""`` is the root group. Groups are written one by one, because an `xarray.DataTree`
    would give the group of a truth the coordinates of its record.
    """
    stream = io.BytesIO()
    mode: Literal["w", "a"] = "w"
    for name, dataset in groups.items():
        dataset.to_netcdf(
            stream, mode=mode, group=name or None, engine=ENGINE, encoding=_encoding(dataset)
        )
        mode = "a"
    return with_digest(stream.getvalue())


def read_group(path: Path | str, group: str = "") -> xr.Dataset:
    """Read one group into memory. The name ``""`` is the root group.

    Raises RecordError if there is no such file or group, or if the file is damaged. A file without
    a digest must also be readable within the limits of `identify.files.untrusted` and
    `identify.files.limited_process`.
    """
    names, dataset = _read(path, group)
    if dataset is None:
        raise RecordError(f"{path} has no group {group!r}; it has {', '.join(names) or 'none'}")
    return dataset


def group_names(path: Path | str) -> list[str]:
    """Return the sorted names of all groups except the root, nested ones as ``run01/truth``.

    Raises RecordError as `read_group` does.
    """
    return _read(path, None)[0]


def _read(path: Path | str, group: str | None) -> Content:
    if Path(path).is_dir():
        inside = Path(path) / "experiment.nc"
        record = f"; its record is {inside}" if inside.is_file() else ""
        raise RecordError(f"{path} is a folder{record}")
    if not Path(path).is_file():
        raise RecordError(f"there is no file {path}")
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise RecordError(f"cannot read {path}: {error.strerror or error}") from None
    # A file with the right digest is as this program wrote it, unless somebody forged the digest.
    if has_digest(path, content):
        return load(content, group)
    try:
        return load_in_process(content, group)
    except UntrustedFileError as error:
        raise RecordError(f"{path} is truncated or not a netCDF file: {error}") from None


def _encoding(dataset: xr.Dataset) -> dict[str, dict[str, object]]:
    numeric = [name for name, variable in dataset.variables.items() if variable.dtype.kind in "fiu"]
    compressed = {
        str(name): {"zlib": True, "complevel": 4} for name in numeric if dataset[name].ndim > 1
    }
    # xarray would add a fill value of its own.
    plain = {str(name): {"_FillValue": None} for name in numeric}
    return {name: {**plain[name], **compressed.get(name, {})} for name in plain}


# Dimensions, unit and description of each variable.
Variables = dict[str, tuple[tuple[str, ...], str, str]]

AXIS = ["x", "y", "z"]
ANGLE = ["alpha", "beta", "gamma"]
POSE = AXIS + ANGLE

COORDINATES = {
    "time": ("s", "time since the start of the run"),
    "axis": ("", "position component"),
    "angle": ("", "Euler angle"),
    "joint": ("", "joint number"),
    "acting": ("s", "time at which a command begins to act, on the clock of time"),
    "pose_component": ("", "pose component"),
    "pose_component_2": ("", "pose component"),
}
LABELS: dict[str, list[str]] = {
    "axis": AXIS,
    "angle": ANGLE,
    "pose_component": POSE,
    "pose_component_2": POSE,
}


# Units of joint variables for sliding actuators, by the units for turning actuators.
SLIDING_UNITS = {"rad": "m", "rad/s": "m/s", "N m": "N"}


def with_joint_units(variables: Variables, prismatic: bool) -> Variables:
    """Return the variables with the joint units of sliding (``prismatic``) or turning actuators."""
    if not prismatic:
        return variables
    return {
        name: (dims, SLIDING_UNITS.get(unit, unit) if "joint" in dims else unit, text)
        for name, (dims, unit, text) in variables.items()
    }


def joint_numbers(values: ArrayLike) -> list[int]:
    """Return the joint numbers 1 to n for values (N, n).

    The list is empty for values with fewer than two axes, whose shape is refused later.
    """
    shape = np.shape(values)
    return list(range(1, (shape[-1] if len(shape) > 1 else 0) + 1))


def pose_parts(values: ArrayLike, name: str, position: str, orientation: str) -> dict[str, Array]:
    """Return positions and orientations, each (N, 3), of poses (N, 6) under the two given names.

    Raises RecordError for another shape. The message calls the poses ``name``.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != 6:
        raise RecordError(f"{name} has shape {array.shape}, expected (N, 6)")
    return {position: array[:, :3], orientation: array[:, 3:]}


def described_dataset(
    values: dict[str, Any], time: ArrayLike, variables: Variables, **labels: Any
) -> xr.Dataset:
    """Build a dataset of described variables on a time axis.

    ``labels`` are the coordinates of further dimensions.

    Raises RecordError for an array whose shape does not fit its dimensions.
    """
    coordinates: dict[str, Any] = {"time": np.asarray(time, dtype=float), **LABELS, **labels}
    used = {dim for dims, _, _ in variables.values() for dim in dims}
    for name, (dims, _, _) in variables.items():
        expected = tuple(len(coordinates[dim]) for dim in dims)
        if np.shape(values[name]) != expected:
            raise RecordError(
                f"{name} has shape {np.shape(values[name])}, expected {dims} = {expected}"
            )
    return xr.Dataset(
        {
            name: (dims, values[name], {"units": unit, "long_name": text})
            for name, (dims, unit, text) in variables.items()
        },
        coords={
            dim: (dim, coordinates[dim], _description(dim)) for dim in coordinates if dim in used
        },
    )


def check_variables(data: xr.Dataset, variables: Variables, source: str) -> None:
    """Raise RecordError if a dataset lacks a variable, or has it with another shape.

    RecordError is also raised for a time dimension without times. The message names the variable
    and ``source``, the origin of the dataset.
    """
    missing = [name for name in variables if name not in data]
    if missing:
        raise RecordError(f"{source} lacks {', '.join(missing)}")
    for name, (dims, _, _) in variables.items():
        if data[name].dims != dims:
            raise RecordError(f"{source}: {name} has dimensions {data[name].dims}, expected {dims}")
        expected = [len(LABELS[dim]) if dim in LABELS else data[name].sizes[dim] for dim in dims]
        if list(data[name].shape) != expected:
            raise RecordError(
                f"{source}: {name} has shape {data[name].shape}, expected {tuple(expected)}"
            )
    if "time" in data.dims and ("time" not in data.coords or data.sizes["time"] == 0):
        raise RecordError(f"{source} has no time")


def check_finite(values: Array, name: str, source: str) -> None:
    """Raise RecordError if any of the values is not finite.

    The message names the variable and the number of such values.
    """
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise RecordError(
            f"{source}: {bad} of {values.size} values of {name} are not finite numbers"
        )


def _description(dim: str) -> dict[str, str]:
    unit, text = COORDINATES.get(dim, ("", dim))
    return {"units": unit, "long_name": text} if unit else {"long_name": text}


def shown(value: object) -> str:
    """Return an attribute's value on one line of at most 60 characters, as messages show it."""
    return " ".join(repr(plain(value)).split())[:60]


def plain(value: object) -> object:
    """Return the value, with a NumPy number converted to a Python number."""
    return value.item() if isinstance(value, np.generic) else value


def as_number(value: object) -> float:
    """Return an attribute's value as a float. A boolean, or anything but a number, gives NaN."""
    return (
        float(value)
        if isinstance(value, int | float | np.number) and not isinstance(value, bool)
        else np.nan
    )


VARIABLE = "covariance"
PARTS = "source_covariance"
SOURCE = "source"
# An entry of a covariance and the sum of its parts differ by less than this fraction of the product
# of the two standard deviations.
SUM_TOLERANCE = 1e-9
DIMENSIONS = ("parameter", "parameter_2")


def parameter_units(layout: ParameterLayout, others: Sequence[str] = ()) -> dict[str, str]:
    """Return the units of a robot's parameters and of other quantities.

    The names of ``others`` end with ``_`` and the unit. A name without ``_`` has the unit ``1``.
    """
    units = {name: layout.unit(name) for name in layout.names}
    return units | {name: name.rpartition("_")[2] if "_" in name else "1" for name in others}


def covariance_netcdf(
    units: Mapping[str, str], covariance: Array, sources: Mapping[str, Array] | None = None
) -> bytes:
    """Return the content of a file with a covariance (p, p) of quantities.

    `units` are the units of the quantities by their names. `sources` are the parts (p, p) of the
    covariance by the names of the sources of uncertainty.
    """
    labels: dict[str, list[str]] = {name: list(units) for name in DIMENSIONS}
    described = {
        "units": "product of the units of both parameters",
        "long_name": "covariance of the estimates",
    }
    data = xr.Dataset({VARIABLE: (DIMENSIONS, covariance, described)}, coords=labels)
    if sources:
        parts = np.stack(list(sources.values()))
        named = described | {"long_name": "part of the covariance by a source of uncertainty"}
        data[PARTS] = xr.DataArray(parts, dims=(SOURCE, *DIMENSIONS), attrs=named)
        data = data.assign_coords({SOURCE: list(sources)})
    return netcdf({"": data.assign_coords(unit=(DIMENSIONS[0], list(units.values())))})


def read_sources(path: Path | str, covariance: Array) -> dict[str, Array]:
    """Read the parts (p, p) of a covariance (p, p) by the names of the sources of uncertainty.

    Raises RecordError if the file is damaged or has no such parts, or if the sum of the parts is
    not the given covariance.
    """
    data = read_group(path)
    if PARTS not in data or data[PARTS].dims != (SOURCE, *DIMENSIONS):
        raise RecordError(
            f"{path} has no sources of its covariance, because an older version wrote it; repeat: "
            f"cmmsim identify --out {Path(path).parent}"
        )
    parts = np.asarray(data[PARTS].values, dtype=float)
    std = np.sqrt(np.diag(covariance))
    fits = parts.shape[1:] == covariance.shape
    excess = (parts.sum(axis=0) - covariance) / np.outer(std, std) if fits else np.array(np.nan)
    if not np.abs(excess).max() < SUM_TOLERANCE:
        raise RecordError(f"{path}: the parts of the covariance do not add up to the covariance")
    return dict(zip(map(str, data[SOURCE].values), parts, strict=True))


def read_covariance(path: Path | str) -> tuple[tuple[str, ...], Array]:
    """Read the names (q,) of quantities, empty if the file has none, and their covariance (q, q).

    Raises RecordError if the file is damaged or lacks the covariance, if a covariance is not
    finite, or if a variance is not positive.
    """
    data = read_group(path)
    if VARIABLE not in data or data[VARIABLE].dims != DIMENSIONS:
        raise RecordError(f"{path} lacks {VARIABLE} on {' and '.join(DIMENSIONS)}")
    names = tuple(map(str, data[DIMENSIONS[0]].values)) if DIMENSIONS[0] in data.coords else ()
    covariance = np.asarray(data[VARIABLE].values, dtype=float)
    if not np.isfinite(covariance).all() or not (np.diag(covariance) > 0).all():
        raise RecordError(f"{path}: {VARIABLE} has variances that are not positive numbers")
    return names, covariance
