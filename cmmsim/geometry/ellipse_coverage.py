"""Exact share of each pixel that an ellipse covers, with its derivatives.

An ellipse is the image of the unit disc: centre c (2,) plus A (2,2) symmetric, in px. Seen from the disc, a pixel
is a small parallelogram; the area they share is a sum over the parallelogram's sides (Green's theorem), each side
giving two circle sectors and the triangle over its part inside the disc. A change of c or A moves the boundary with a
velocity v(x) = dc + dA A^-1 (x - c), and by the transport theorem

    d|disc and pixel| = integral of div v over the shared area - flux of v through the pixel's sides inside the disc,

where v is linear along a side, so that its value at the middle of the part inside is exact.
"""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.pose import Array

SHAPE_BASIS = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
SHAPE_BASIS.setflags(write=False)


def coverage(centres: Array, shapes: Array, size: int) -> tuple[Array, Array]:
    """Coverage (n, size, size), 0 to 1, and its derivatives (n, size, size, 5) by [c_x, c_y, A_xx, A_xy, A_yy].

    Parameters: centres (n, 2) px, where (0, 0) is the middle of the window's first pixel; shapes (n, 2, 2) px,
    symmetric and positive definite; size: window side in px.
    """
    from cmmsim.geometry.coverage_kernel import cover_windows  # compiles, so it is loaded where it is first needed

    shares, derivatives = np.empty((len(centres), size, size)), np.empty((len(centres), size, size, 5))
    cover_windows(
        np.ascontiguousarray(centres, dtype=float), np.ascontiguousarray(shapes, dtype=float), shares, derivatives
    )
    return shares, derivatives


def covered_area(centres: Array, shapes: Array, size: int) -> Array:
    """Coverage (n, size, size) as ``coverage`` gives it, without derivatives."""
    return coverage(centres, shapes, size)[0]
