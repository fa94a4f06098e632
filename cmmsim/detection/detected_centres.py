"""What a detector hands back for a stack of windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array


@dataclass(frozen=True)
class DetectedCentres:
    """Ellipse centres in n windows, in full-image px.

    centres (n,2); covariances (n,2,2) px², what the pixel noise does to the centres to first order; good (n,) whether
    the window holds one whole bright spot. shapes (n,2,2) px and shape_covariances (n,3,3) px² of A_xx, A_xy, A_yy
    where a detector states them, as misfits (n,), the reduced chi-square of the grey values. Values of windows that are
    not good are finite but mean nothing.
    """

    centres: Array
    covariances: Array
    good: NDArray[np.bool_]
    shapes: Array | None = None
    shape_covariances: Array | None = None
    misfits: Array | None = None


def no_centres() -> DetectedCentres:
    """The result for no windows."""
    return DetectedCentres(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))
