"""Reading of netCDF content, also from files that somebody else made or that may be damaged.

The library can hang, crash, or ask for all memory on such a file. Another process therefore reads
it within limits, and is ended if it exceeds them.
"""

import io
import math
import os
import pickle
import signal
import subprocess
import sys
from contextlib import suppress
from typing import Literal

import h5py
import xarray as xr

ENGINE: Literal["h5netcdf"] = "h5netcdf"

LIMIT_S = 8
"""Seconds that the reading may take."""
START_S = 60
"""Additional seconds for the process to start on a busy machine."""
LIMIT_BYTES = 256_000_000
"""Largest size of the numbers in a file: that of a record of a million frames."""
LIMIT_MEMORY = 1_000_000_000
"""Largest number of bytes that the reading may allocate, if the system can limit them."""

CODE = "from identify.files.stranger import serve; serve()"
TOO_LONG = f"it cannot be read within {LIMIT_S} s"

Content = tuple[list[str], xr.Dataset | None]
"""Names of the groups, and a group; None if it was not asked for or does not exist."""


class StrangerError(Exception):
    """Reason, in one line, why a file cannot be read."""


def load(content: bytes, group: str | None, most: float = math.inf) -> Content:
    """Load a group of at most this many bytes of numbers, and the names of all groups.

    Raises the library's errors, and ValueError if the group is larger.
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
                f"it holds {dataset.nbytes / 1e6:.0f} MB, the limit is {most / 1e6:.0f} MB"
            )
        return names, dataset.load()


def load_elsewhere(content: bytes, group: str | None) -> Content:
    """Load as `load` does, in another process and within the limits.

    Raises StrangerError.
    """
    limited = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-c", CODE, *([] if group is None else [group])]
    try:
        done = subprocess.run(
            command,
            input=content,
            capture_output=True,
            timeout=START_S + LIMIT_S,
            env=limited,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise StrangerError(TOO_LONG) from None
    if _ended_by_alarm(done.returncode):
        raise StrangerError(TOO_LONG)
    if done.returncode:
        raise StrangerError(f"the netCDF library ends with status {done.returncode} on it")
    found = pickle.loads(done.stdout)
    if isinstance(found, str):
        raise StrangerError(found)
    names, dataset = found
    return names, dataset


def _ended_by_alarm(status: int) -> bool:
    return hasattr(signal, "SIGALRM") and status == -signal.SIGALRM


def serve() -> None:
    """Load the content on standard input, and write a pickle of it or of the reason for failure."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_MEMORY, LIMIT_MEMORY))
    # Whatever the library prints must not get among the bytes of the pickle.
    out = sys.stdout
    sys.stdout = sys.stderr
    found: Content | str
    content = sys.stdin.buffer.read()
    group = sys.argv[1] if len(sys.argv) > 1 else None
    if hasattr(signal, "alarm"):  # elsewhere the other process alone watches the time
        signal.alarm(LIMIT_S)
    try:
        found = load(content, group, LIMIT_BYTES)
    except Exception as error:  # whatever the library makes of such a file
        found = " ".join(str(error).split()) or type(error).__name__
    out.buffer.write(pickle.dumps(found))
