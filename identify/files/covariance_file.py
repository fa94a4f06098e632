"""``covariance.nc``: the covariance of the estimated parameters, netCDF, in the SI units of the parameters."""

from pathlib import Path

import numpy as np
import xarray as xr

from dynamics.parameters import unit_of
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.netcdf import read_group, write_groups

VARIABLE = "covariance"
DIMENSIONS = ("parameter", "parameter_2")


def write_covariance(path: Path | str, names: tuple[str, ...], covariance: Array) -> None:
    """Write the covariance (n, n) of named parameters."""
    labels = {name: list(names) for name in DIMENSIONS}
    described = {"units": "product of the units of both parameters", "long_name": "covariance of the estimates"}
    data = xr.Dataset({VARIABLE: (DIMENSIONS, covariance, described)}, coords=labels)
    write_groups(path, {"": data.assign_coords(unit=(DIMENSIONS[0], [unit_of(name) for name in names]))})


def read_covariance(path: Path | str, names: tuple[str, ...]) -> Array:
    """Read the covariance (n, n) of the parameters `names`.

    Raises:
        RecordError: a file that is damaged, of other parameters, or with variances that are none.
    """
    data = read_group(path)
    if VARIABLE not in data or data[VARIABLE].dims != DIMENSIONS:
        raise RecordError(f"{path} lacks {VARIABLE} on {' and '.join(DIMENSIONS)}")
    found = tuple(map(str, data[DIMENSIONS[0]].values)) if DIMENSIONS[0] in data.coords else ()
    if found != tuple(names):
        different = sorted(set(found) ^ set(names))
        raise RecordError(f"{path} is of other parameters than the result: {', '.join(different) or 'another order'}")
    covariance = np.asarray(data[VARIABLE].values, dtype=float)
    if not np.isfinite(covariance).all() or not (np.diag(covariance) > 0).all():
        raise RecordError(f"{path}: {VARIABLE} has variances that are not positive numbers")
    return covariance
