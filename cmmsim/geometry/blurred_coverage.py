"""Share of light in each pixel of an ellipse blurred by a Gaussian point spread, with its derivatives.

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

NARROWEST_PX = 0.05


def blurred_coverage(centres: Array, shapes: Array, size: int, psf_px: float) -> tuple[Array, Array]:
    """Shares (n, size, size), 0 to 1, and their derivatives (n, size, size, 5) by [c_x, c_y, A_xx, A_xy, A_yy].

    Parameters: centres (n, 2) px, where (0, 0) is the middle of the window's first pixel; shapes (n, 2, 2) px,
    symmetric and positive definite; size: window side in px; psf_px: sigma of the point spread. Raises CmmError for
    one narrower than NARROWEST_PX.
    """
    from cmmsim.geometry.blur_kernel import blur_windows  # compiles, so it is loaded where it is first needed

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
