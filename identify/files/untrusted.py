"""Reading of netCDF content that can be damaged, or come from an untrusted source."""

import io
import math
from typing import Literal

import h5py
import xarray as xr

from identify.files.limited_process import within_limits

ENGINE: Literal["h5netcdf"] = "h5netcdf"

# Largest size of the numbers in a group, bytes. A record of half a million frames has this size.
LIMIT_BYTES = 256_000_000
# Names of the groups, and one group. The group is None if it was not requested or does not exist.
Content = tuple[list[str], xr.Dataset | None]


def load(content: bytes, group: str | None, most: float = math.inf) -> Content:
    """Load the sorted names of all groups, and a group of at most ``most`` bytes of numbers.

    Raises the exceptions of the library, and ValueError if the group is larger.
    """
    names: list[str] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Group) else None
        )
    names.sort()
    if group is None or (group and group not in names):
        return names, None
    with xr.open_dataset(io.BytesIO(content), group=group or None, engine=ENGINE) as dataset:
        if dataset.nbytes > most:
            raise ValueError(
                f"it holds {dataset.nbytes / 1e6:.0f} MB, but the limit is {most / 1e6:.0f} MB"
            )
        return names, dataset.load()


def load_in_process(content: bytes, group: str | None) -> Content:
    """Load as `load` does, but in another process and within limits of time and memory.

    Raises UntrustedFileError if the content exceeds the limits or cannot be read.
    """
    loaded: Content = within_limits(load, content, group, LIMIT_BYTES)
    return loaded
