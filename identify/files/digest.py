"""A digest of arrays: of their numbers, not of a file's bytes, which differ from one writing to the next."""

from collections.abc import Mapping
from hashlib import sha256

import numpy as np
from numpy.typing import ArrayLike


def array_digest(arrays: Mapping[str, ArrayLike]) -> str:
    """Digest of named arrays of numbers, hexadecimal; their order and their type do not matter."""
    whole = sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name], dtype="<f8")
        whole.update(f"{name} {values.shape}\n".encode())
        whole.update(np.where(np.isnan(values), np.nan, values).tobytes())  # one of the many bit patterns of NaN
    return whole.hexdigest()
