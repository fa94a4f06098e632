"""Centre of an ellipse from the gradients at all pixels of its edge: the dual conic operator.

Through each pixel (x, y) of the edge passes a line perpendicular to the gradient (a, b): l = (a, b,
c) with c = -(a x + b y). Lines that touch the ellipse satisfy l' C* l = 0 with its dual conic C* =
[[A, B/2, D/2], [B/2, C, E/2], [D/2, E/2, 1]]. The equation is linear in the five unknowns, and
(D/2, E/2) is the centre. The gradient (a, b) is not normalised. The residual of each line is thus
weighted by |gradient|², and pixels away from the edge need not be removed. Source: J.-N. Ouellet,
P. Hebert, Precise ellipse estimation without contour point extraction, Machine Vision and
Applications 21 (2009).

With the unknowns u = (A, B, C, D, E) and k = (a², a b, b², a c, b c), the normal equations are: sum
over lines of k (k' u + c²) = 0. The noise of a pixel changes the gradients around the pixel. The
implicit function theorem, applied to the normal equations, gives the effect on the centre.

If the rim comes near the edge of the window, lines are missing, and the centre is wrong by up to a
tenth of a pixel. A window is therefore good only if the distance of the rim from the edge is at
least EDGE_PX plus the standard deviation of the point spread.

Gradients of a sharp edge are not exact. In noise-free images of stickers tilted by 45 degrees, the
error of the centre is about 0.004 px rms at radius 3.8 px, 0.007 at 2.5 and 0.002 at 10. The
covariance does not include this bias.
"""

import numpy as np
from scipy import ndimage

from cmmsim.detection.detector import DetectedCentres, Detector, SpotWindows, no_centres
from cmmsim.detection.grey_centroid import BrightSpots, bright_spots, whole_inside
from cmmsim.geometry.pose import Array

# Central difference along the slope.
SLOPE = (-0.5, 0.0, 0.5)
# Smoothing perpendicular to the slope (Scharr): the most isotropic kernel of this size.
SMOOTHING = (0.1875, 0.625, 0.1875)
# Smallest distance from a sharp rim to the edge of the window, px. Gradients extend 1.5 px from the
# rim, and the outermost pixels have no gradient.
EDGE_PX = 2
# Reciprocal condition number below which the lines do not determine an ellipse.
SMALLEST_CONDITION = 1e-9


def detect_by_dual_conic(spot_windows: SpotWindows) -> DetectedCentres:
    """Return centres by the dual conic operator.

    The point spread only increases the required distance of the rim from the window's edge. Smears
    are ignored.
    """
    if len(spot_windows.windows) == 0:
        return no_centres()
    spots = bright_spots(spot_windows)
    lines = _edge_lines(spots)
    basis = np.stack(
        [lines.a**2, lines.a * lines.b, lines.b**2, lines.a * lines.c, lines.b * lines.c]
    )
    normal = np.einsum("inyx,jnyx->nij", basis, basis)
    determined = np.linalg.cond(normal) < 1.0 / SMALLEST_CONDITION
    # these windows are not good, so any regular matrix can take the place of a singular one
    normal[~determined] = np.eye(5)
    dual = np.linalg.solve(normal, -np.einsum("inyx,nyx->ni", basis, lines.c**2)[..., None])[..., 0]
    centres = 0.5 * dual[:, 3:] * lines.unit_px[:, None] + spots.centroids
    jacobian = _centre_by_pixels(lines, basis, normal, dual)
    variance = spot_windows.noise.variance(spots.windows)
    covariances = np.einsum("niyx,njyx,nyx->nij", jacobian, jacobian, variance)
    squared = _squared_shape(dual) * lines.unit_px[:, None, None] ** 2
    good = (
        (spots.contrast >= spot_windows.limits.smallest_contrast)
        & determined
        & (np.linalg.eigvalsh(squared)[:, 0] > 0.0)
    )
    good &= whole_inside(
        centres, 0.25 * squared, spot_windows.fit_size, EDGE_PX + spot_windows.psf_px
    )
    return DetectedCentres(centres + spots.corners, covariances, good)


DUAL_CONIC = Detector("dual_conic", detect_by_dual_conic, 0.004, EDGE_PX)


class _EdgeLines:
    """Lines (a, b, c), each (n, h, h), relative to the centroids and in units of ``unit_px`` (n,).

    ``x`` (n, 1, h) and ``y`` (n, h, 1) are the coordinates of the pixels. ``scale`` (n, h, h) is
    the inverse contrast for lines that count, and 0 for others. A line counts if its pixel lies on
    the spot or its dark ring, and if all neighbours of the pixel are in the window.
    """

    def __init__(
        self, a: Array, b: Array, x: Array, y: Array, unit_px: Array, scale: Array
    ) -> None:
        self.a = a
        self.b = b
        self.x = x
        self.y = y
        self.unit_px = unit_px
        self.scale = scale
        self.c = -(a * x + b * y)


def _edge_lines(spots: BrightSpots) -> _EdgeLines:
    """Return lines from the gradients of the grey values, divided by the contrast."""
    radius = 2.0 * np.sqrt(np.maximum(0.5 * np.trace(spots.spreads, axis1=1, axis2=2), 0.25))
    ticks = np.arange(spots.windows.shape[1], dtype=float)
    x = (ticks - spots.centroids[:, :1])[:, None, :] / radius[:, None, None]
    y = (ticks - spots.centroids[:, 1:])[:, :, None] / radius[:, None, None]
    counted = spots.within.copy()
    # The outermost pixels lack neighbours for their gradients.
    counted[:, [0, -1]] = counted[:, :, [0, -1]] = False
    scale = counted / np.maximum(spots.contrast, 1.0)[:, None, None]
    a = _filtered(spots.windows, SLOPE, SMOOTHING) * scale
    b = _filtered(spots.windows, SMOOTHING, SLOPE) * scale
    return _EdgeLines(a, b, x, y, radius, scale)


def _filtered(
    values: Array, along_x: tuple[float, ...], along_y: tuple[float, ...], adjoint: bool = False
) -> Array:
    """Return the correlation of values (n, h, h) with a separable kernel, or its adjoint.

    Values outside of the windows are taken as zero.
    """
    direction = -1 if adjoint else 1
    across = ndimage.correlate1d(values, along_x[::direction], axis=2, mode="constant")
    return ndimage.correlate1d(across, along_y[::direction], axis=1, mode="constant")


def _centre_by_pixels(lines: _EdgeLines, basis: Array, normal: Array, dual: Array) -> Array:
    """Return the derivatives (n, 2, h, h) of the centres, px, with respect to the grey values."""
    a = lines.a
    b = lines.b
    c = lines.c
    x = lines.x
    y = lines.y
    zero = np.zeros_like(lines.a)
    rows = np.linalg.inv(normal)[:, 3:]  # the rows of D and E
    residual = np.einsum("ni,inyx->nyx", dual, basis) + c * c
    total = np.zeros((len(a), 2, *a.shape[1:]))
    for basis_by, c_by, kernels in (
        (np.stack([2.0 * a, b, zero, c - a * x, -b * x]), -x, (SLOPE, SMOOTHING)),
        (np.stack([zero, a, 2.0 * b, -a * y, c - b * y]), -y, (SMOOTHING, SLOPE)),
    ):
        residual_by = np.einsum("ni,inyx->nyx", dual, basis_by) + 2.0 * c * c_by
        change = -np.einsum("nki,inyx->nkyx", rows, basis_by * residual + basis * residual_by)
        for k in range(2):
            total[:, k] += _filtered(change[:, k] * lines.scale, *kernels, adjoint=True)
    return 0.5 * lines.unit_px[:, None, None, None] * total


def _squared_shape(dual: Array) -> Array:
    """Return A A' (n, 2, 2) of the ellipse: z z' minus the upper left part of C*, with centre z."""
    centre = 0.5 * dual[:, 3:]
    upper_left = np.stack(
        [dual[:, 0], 0.5 * dual[:, 1], 0.5 * dual[:, 1], dual[:, 2]], axis=1
    ).reshape(-1, 2, 2)
    return centre[:, :, None] * centre[:, None, :] - upper_left
