"""How kernels are compiled: by numba, once, into a cache on disk.

Modules called ``*kernels`` hold functions of numbers and arrays only. They are imported where they are first needed,
because importing numba takes time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numba.core.dispatcher import Dispatcher

Array = np.ndarray  # of any type and shape, which each docstring states
F = TypeVar("F", bound=Callable)


def compiled(function: F) -> Dispatcher[F]:
    """Compile a kernel on its first call, or load it from the cache: beside the source, else in the user's cache."""
    try:
        kernel = njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder can be written to
        return njit(nogil=True, error_model="numpy")(function)
    if hasattr(kernel, "_cache"):
        # numba asks only whether the function's own file has changed, but kernels call kernels of other files
        kernel._cache._cache_file._source_stamp = _stamp()
    return kernel


@lru_cache(maxsize=1)
def _stamp() -> str:
    """Changes when any kernel changes."""
    files = sorted(Path(__file__).parent.rglob("*kernels.py"))
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
