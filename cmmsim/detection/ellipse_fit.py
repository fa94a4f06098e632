"""Maximum-likelihood fit of a bright ellipse on a dark ground to the grey values of many windows.

The model of a grey value is ground + contrast * share. The share of light is the fraction of the
pixel that the ellipse covers, blurred by the point spread and, if known, by the movement during the
exposure. Gauss-Newton solves for the seven parameters [c_x, c_y, A_xx, A_xy, A_yy, contrast,
ground]. The weight of a grey value is the inverse of the camera's noise variance at the fitted
value. The inverse of the normal matrix is the covariance of the parameters.
``ellipse_fit_kernels`` computes the fit.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.detector import DetectedCentres, Detector, FitLimits, SpotWindows
from cmmsim.geometry.disc_image import require_psf
from cmmsim.geometry.pose import Array, frozen
from cmmsim.radiometry.noise import CameraNoise

if TYPE_CHECKING:
    from cmmsim.detection.ellipse_fit_kernels import FitSettings

# Pixels beyond this many sticker radii can lie outside the dark ring and are not fitted.
RING_REACH = 2.4
# Smallest semi-axis of an ellipse. A fit that ends near it is not good.
SMALLEST_RADIUS_PX = 0.8
# Number of the parameters c_x, c_y, A_xx, A_xy, A_yy, which come first.
ELLIPSE_UNKNOWNS = 5
# Largest distance between the positions over which the light of a moving ellipse is summed. Half a
# point spread is used if that is more.
SMEAR_STEP_PX = 0.2
# A fit ends after a step that changes each parameter of the ellipse by less than this.
CONVERGED_PX = 1e-4
# Rms difference between noise-free images and the model of a pixel, divided by the contrast.
MODEL_ERROR = 0.0025
# Smallest number of windows for which a second thread saves time.
FEWEST_FOR_A_THREAD = 16


@dataclass(frozen=True)
class EllipseFits(DetectedCentres):
    """Result of the fits in n windows, with all optional arrays of ``DetectedCentres``.

    ``contrast`` and ``ground`` (n,) are in grey values. ``lights`` (n, 7) describe two extensions
    of the fit, each to first order. Entries 0 and 1 are the shift x, y of the centre, px, if light
    that rises across the sticker were fitted too. Entries 2 to 4 are xx, xy and yy of the
    covariance of this shift, px². Entries 5 and 6 are the right-hand side and the information for
    one more unknown: half the variance, px², of a blur that the model does not contain. All entries
    are zero if rising light was fitted, and in simulated fits.
    """

    shapes: Array = field()  # without a default, unlike in the base class
    shape_covariances: Array = field()
    misfits: Array = field()
    contrast: Array
    ground: Array
    lights: Array

    def within(self, limits: FitLimits, noise: CameraNoise) -> "EllipseFits":
        """Return the fits, with those that violate the limits marked as not good."""
        good = self.good & (self.contrast >= limits.smallest_contrast)
        return replace(
            self,
            good=good
            & (self.misfits <= largest_misfits(limits, noise, self.contrast, self.ground)),
        )


def detect_by_maximum_likelihood(spots: SpotWindows) -> DetectedCentres:
    """Return centres of the maximum-likelihood fit of a blurred ellipse."""
    return fit_ellipses(**vars(spots))


MAXIMUM_LIKELIHOOD = Detector("maximum_likelihood", detect_by_maximum_likelihood)


def fit_ellipses(
    windows: NDArray,
    corners: NDArray[np.integer],
    noise: CameraNoise,
    fit_size: int,
    limits: FitLimits | None = None,
    iterations: int = 8,
    psf_px: float = 0.0,
    smears: Array | None = None,
    lit: bool = False,
) -> EllipseFits:
    """Fit one ellipse in each of n windows (n, h, h) of grey values.

    The windows begin at pixels ``corners`` (n, 2) (x, y) of the whole image. The part of
    ``fit_size`` px around the bright spot is fitted. ``psf_px`` is the standard deviation of the
    Gaussian point spread. The spots move by ``smears`` (n, 2) px during the exposure, and the
    centres are those at its middle. If ``lit`` is True, light that rises across each sticker is
    fitted too. ``iterations`` is the largest number of steps. Raises CmmError for a point spread
    that cannot be modelled.
    """
    require_psf(psf_px)
    from cmmsim.detection.ellipse_fit_kernels import LIT_UNKNOWNS, UNKNOWNS, fit_windows

    n = len(windows)
    part_corners = np.empty((n, 2))
    parameters = np.empty((n, LIT_UNKNOWNS if lit else UNKNOWNS))
    lights = np.empty((n, 7))
    misfits = np.empty(n)
    shapes = np.empty((n, 2, 2))
    covariances = np.empty((n, ELLIPSE_UNKNOWNS, ELLIPSE_UNKNOWNS))
    settings = fit_settings(noise, psf_px, iterations)
    movements = np.zeros((n, 2)) if smears is None else np.ascontiguousarray(smears, dtype=float)
    # kernels are compiled for floats in C order
    pixels = np.ascontiguousarray(windows, dtype=float)

    def fit(part: slice) -> None:
        results = (
            values[part]
            for values in (part_corners, parameters, shapes, covariances, misfits, lights)
        )
        fit_windows(pixels[part], movements[part], fit_size, settings, *results)

    _in_two_threads(fit, n)
    fits = EllipseFits(
        parameters[:, :2] + part_corners + corners,
        covariances[:, :2, :2],
        lies_inside(parameters[:, :2], shapes, fit_size),
        shapes,
        covariances[:, 2:, 2:],
        misfits,
        parameters[:, 5],
        parameters[:, 6],
        lights,
    )
    return fits.within(limits or FitLimits(), noise)


@lru_cache(maxsize=16)
def fit_settings(noise: CameraNoise, psf_px: float, iterations: int = 8) -> "FitSettings":
    """Return the settings of the fit for a camera's noise and point spread.

    The grey values are those in which stickers are bright; see ``CameraNoise.bright``.
    """
    from cmmsim.detection.ellipse_fit_kernels import FitSettings

    scale = noise.white_level / 255.0
    greys = scale * _GREYS
    return FitSettings(
        RING_REACH,
        SMALLEST_RADIUS_PX,
        _LARGEST_STEP * [1.0, 1.0, 1.0, 1.0, 1.0, scale, scale, 1.0, 1.0],
        iterations,
        CONVERGED_PX,
        float(psf_px),
        max(SMEAR_STEP_PX, 0.5 * psf_px),
        noise.variance(greys),
        greys[0],
        1.0 / (greys[1] - greys[0]),
        noise.black_of_bright,
    )


def _in_two_threads(fit: Callable[[slice], None], count: int) -> None:
    """Fit windows 0 to ``count`` - 1, half of them in a second thread if there are many.

    Each call starts a new thread. This costs 50 us, but a permanent thread would be missing in
    forked processes. There is no second thread if NUMBA_NUM_THREADS or the machine allows only one.
    """
    from numba.core.config import NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set at run time

    if count < FEWEST_FOR_A_THREAD or NUMBA_NUM_THREADS == 1:
        fit(slice(0, count))
        return
    second = threading.Thread(target=fit, args=(slice(count // 2, count),))
    second.start()
    fit(slice(0, count // 2))
    second.join()


# Largest steps of a fit: centre and shape in px, contrast and ground in grey values of 0 to 255,
# and the relative rise of the light per px.
_LARGEST_STEP = frozen([1.0, 1.0, 0.8, 0.8, 0.8, 100.0, 40.0, 0.1, 0.1])
# Grey values, on a scale of 0 to 255, at which the noise variance is tabulated.
_GREYS = frozen(np.arange(-64.0, 512.0, 0.25))


def largest_misfits(limits: FitLimits, noise: CameraNoise, contrast: Array, ground: Array) -> Array:
    """Return the largest accepted reduced chi-square (n,) for contrasts and grounds (n,).

    Contrasts and grounds are grey values. The fit uses a rounding variance that is averaged over
    all mean grey values. If the noise is below half a grey value, two further errors become
    visible. The rounding variance of a uniform ground differs from its average, and the model of a
    pixel is not exact. The limit is raised to allow for both.
    """
    model = (MODEL_ERROR * contrast) ** 2 / noise.variance(ground)
    return limits.largest_misfit * (noise.rounding_excess(ground) + model)


def lies_inside(centres: Array, shapes: Array, size: int) -> NDArray[np.bool_]:
    """Return a mask (n,) of ellipses that lie inside the window and exceed the smallest radius.

    The centres (n, 2) px are relative to the first pixel of a window of ``size`` px.
    """
    reach = np.linalg.norm(shapes, axis=2)  # half extent along x and y
    inside = np.all((centres - reach > -0.5) & (centres + reach < size - 0.5), axis=1)
    mean = 0.5 * (shapes[:, 0, 0] + shapes[:, 1, 1])
    smallest = mean - np.hypot(0.5 * (shapes[:, 0, 0] - shapes[:, 1, 1]), shapes[:, 0, 1])
    return inside & (smallest > 1.01 * SMALLEST_RADIUS_PX)
