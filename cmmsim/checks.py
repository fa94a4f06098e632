"""What users pass as arguments: taken as it is meant, or refused with what was got and what is wanted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmmsim.errors import CmmError, ShapeError

SHOWN_CHARACTERS = 120  # of what is refused


def finite_array(values: ArrayLike, shape: tuple[int, ...], wanted: str) -> NDArray[np.float64]:
    """Values as an array of that shape. Raises ShapeError, which says what is ``wanted``, for anything else than
    finite real numbers."""
    try:
        found = np.asarray(values)
        numbers = found.astype(float) if found.dtype.kind in "fiubO" else None
    except (TypeError, ValueError, OverflowError):  # ragged, or objects that are no numbers
        numbers = None
    if numbers is None:
        raise ShapeError(f"{wanted}, got {_shown(values)}")
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ShapeError(f"{wanted}, got shape {numbers.shape}: {_shown(numbers)}")
    return numbers


def require_kind(value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise CmmError, which says what is ``wanted``, unless the value is an instance of a class."""
    if not isinstance(value, kind):
        raise CmmError(f"{wanted}, got {_shown(value)} of type {type(value).__name__}")


def _shown(values: object) -> str:
    """Values on one line, cut where they are many."""
    text = " ".join(str(values).split())
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
