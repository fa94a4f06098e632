"""What users pass as numbers, turned into arrays or refused by name."""

import numpy as np
from numpy.typing import ArrayLike

from dynamics.errors import ShapeError


def rows(name: str, value: ArrayLike, width: int) -> np.ndarray:
    """The value as floats of shape (width,) or (N, width), never transposed, padded or cast from complex numbers.

    Raises ShapeError, which names the array, its shape, or the place of an entry that is not finite.
    """
    try:
        array = np.asarray(value)
        if np.iscomplexobj(array):
            raise TypeError
        array = array.astype(float, copy=False)
    except (TypeError, ValueError):
        raise ShapeError(f"{name} must be numbers of shape ({width},) or (N, {width}), got {value!r:.60}") from None
    if array.ndim not in (1, 2) or array.shape[-1] != width:
        raise ShapeError(f"{name} must have shape ({width},) or (N, {width}), got {array.shape}")
    if not np.isfinite(array).all():
        place = tuple(int(index) for index in np.argwhere(~np.isfinite(array))[0])
        raise ShapeError(f"{name}{list(place)} is {array[place]}, must be finite")
    return array
