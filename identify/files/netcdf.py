"""Groups of xarray datasets in one netCDF file: written whole or not at all, read with clear errors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import h5py
import xarray as xr

from identify.errors import RecordError
from identify.files.atomic import atomic_path

ENGINE: Literal["h5netcdf"] = "h5netcdf"


def write_groups(path: Path | str, groups: Mapping[str, xr.Dataset]) -> None:
    """Write datasets as groups of one file; the name ``""`` is the main group.

    Nothing is left behind, and an older file of this name stays as it was, when writing fails.
    """
    with atomic_path(path) as temporary:
        mode: Literal["w", "a"] = "w"
        for name, dataset in groups.items():
            dataset.to_netcdf(temporary, mode=mode, group=name or None, engine=ENGINE, encoding=_encoding(dataset))
            mode = "a"


def read_group(path: Path | str, group: str = "") -> xr.Dataset:
    """Read one group into memory.

    Raises:
        RecordError: no such file, not a whole netCDF file, or no such group.
    """
    names = group_names(path)
    if group and group not in names:
        raise RecordError(f"{path} has no group {group!r}; it has {', '.join(names) or 'none'}")
    try:
        with xr.open_dataset(path, group=group or None, engine=ENGINE) as dataset:
            return dataset.load()
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise RecordError(f"{path} is truncated or not a netCDF file: {error}") from error


def group_names(path: Path | str) -> list[str]:
    """Names of all groups, nested ones as ``run01/truth``.

    Raises:
        RecordError: no such file, or not a whole netCDF file.
    """
    if not Path(path).is_file():
        raise RecordError(f"there is no file {path}")
    names: list[str] = []
    try:
        with h5py.File(path, "r") as file:
            file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Group) else None)
    except (OSError, RuntimeError) as error:
        raise RecordError(f"{path} is truncated or not a netCDF file: {error}") from error
    return sorted(names)


def _encoding(dataset: xr.Dataset) -> dict[str, dict[str, object]]:
    numbers = [name for name, variable in dataset.variables.items() if variable.dtype.kind in "fiu"]
    compressed = {str(name): {"zlib": True, "complevel": 4} for name in numbers if dataset[name].ndim > 1}
    plain = {str(name): {"_FillValue": None} for name in numbers}
    return {name: {**plain[name], **compressed.get(name, {})} for name in plain}
