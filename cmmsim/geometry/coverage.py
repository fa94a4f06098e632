"""How much of each pixel an ellipse covers, sharp or blurred by the lens, with derivatives.

Exact share of each pixel that an ellipse covers, with its derivatives.
An ellipse is the image of the unit disc: centre c (2,) plus A (2,2) symmetric, in px. Seen from the disc, a pixel
is a small parallelogram; the area they share is a sum over the parallelogram's sides (Green's theorem), each side
giving two circle sectors and the triangle over its part inside the disc. A change of c or A moves the boundary with a
velocity v(x) = dc + dA A^-1 (x - c), and by the transport theorem

    d|disc and pixel| = integral of div v over the shared area - flux of v through the pixel's sides inside the disc,

where v is linear along a side, so that its value at the middle of the part inside is exact.

Share of light in each pixel of an ellipse blurred by a Gaussian point spread, with its derivatives.
The share is the integral over the ellipse of g_i(x) g_j(y), where g_i(x) is what the point spread carries from a point
x into pixel i. By the divergence theorem it is an integral along the rim x(t) = c + A (cos t, sin t),

    share = integral of P_i(x) g_j(y) n_x ds,   P_i' = g_i,

and a change of the ellipse, which moves the rim by v = dc + dA (cos t, sin t), changes it by

    d share = integral of g_i(x) g_j(y) v . n ds.

Both are smooth and periodic in t, so the trapezoidal rule converges exponentially once its points lie closer than the
point spread is wide.
"""

from __future__ import annotations

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

SHAPE_BASIS = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
SHAPE_BASIS.setflags(write=False)


def coverage(centres: Array, shapes: Array, size: int) -> tuple[Array, Array]:
    """Coverage (n, size, size), 0 to 1, and its derivatives (n, size, size, 5) by [c_x, c_y, A_xx, A_xy, A_yy].

    Parameters: centres (n, 2) px, where (0, 0) is the middle of the window's first pixel; shapes (n, 2, 2) px,
    symmetric and positive definite; size: window side in px.
    """
    from cmmsim.geometry.disc_kernels import cover_windows  # compiles, so it is loaded where it is first needed

    shares, derivatives = np.empty((len(centres), size, size)), np.empty((len(centres), size, size, 5))
    cover_windows(
        np.ascontiguousarray(centres, dtype=float), np.ascontiguousarray(shapes, dtype=float), shares, derivatives
    )
    return shares, derivatives


def covered_area(centres: Array, shapes: Array, size: int) -> Array:
    """Coverage (n, size, size) as ``coverage`` gives it, without derivatives."""
    return coverage(centres, shapes, size)[0]


NARROWEST_PX = 0.05


def blurred_coverage(centres: Array, shapes: Array, size: int, psf_px: float) -> tuple[Array, Array]:
    """Shares (n, size, size), 0 to 1, and their derivatives (n, size, size, 5) by [c_x, c_y, A_xx, A_xy, A_yy].

    Parameters: centres (n, 2) px, where (0, 0) is the middle of the window's first pixel; shapes (n, 2, 2) px,
    symmetric and positive definite; size: window side in px; psf_px: sigma of the point spread. Raises CmmError for
    one narrower than NARROWEST_PX.
    """
    from cmmsim.geometry.disc_kernels import blur_windows  # compiles, so it is loaded where it is first needed

    require_psf(psf_px)
    shares, derivatives = np.empty((len(centres), size, size)), np.empty((len(centres), size, size, 5))
    blur_windows(
        np.ascontiguousarray(centres, dtype=float),
        np.ascontiguousarray(shapes, dtype=float),
        float(psf_px),
        shares,
        derivatives,
    )
    return shares, derivatives


def require_psf(psf_px: float) -> None:
    """Raise CmmError for a point spread that is neither 0 nor wide enough to be followed."""
    if not (psf_px == 0.0 or NARROWEST_PX <= psf_px < np.inf):
        raise CmmError(f"a point spread of {psf_px:g} px cannot be fitted, only 0 or at least {NARROWEST_PX:g} px")
