"""Allowance of the fit of stickers for print that is not perfect.

Uneven print and outlines that are not round move a sticker's centre. Most of this movement is the
same in all frames, and is contained in the taught places of the stickers. The rest changes with the
place of the centre within a pixel, and acts like noise. The factors below were found from images
without noise, with stickers of 3 to 4 px radius.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from cmmsim.detection.detector import FitLimits
from cmmsim.files.printed import print_sizes
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.radiometry.noise import CameraNoise

# Probability that light that rises across the stickers is fitted in a frame with even light. It is
# fitted if it moves the pose further than noise does in all but this fraction of frames.
LIGHT_CHANCE = 1e-4
# Largest squared movement of the pose in units of its noise.
LARGEST_LIGHT = float(chdtri(6, LIGHT_CHANCE))
# Errors of a centre, px, for an unevenness of 1, and for an outline that is off by 1 px. Errors
# that change with the place of the centre within a pixel are smaller with a point spread.
CONSTANT = (0.04, 0.08)
CHANGING = (0.12, 0.10)
CHANGING_BLURRED = (0.04, 0.03)
# Errors of the entries of an ellipse's matrix, px, for an unevenness of 1, an outline that is off
# by 1 px, and a rim of 1 px.
SHAPE = (0.5, 0.8, 0.7)
# Ratio of the largest increase of a misfit by print to the mean increase.
MISFIT_SPREAD = 4.0


@dataclass(frozen=True)
class PrintAllowance:
    """Sizes of the errors that print causes, and limits that follow from them.

    constant_px     rms of errors of a centre that are the same in all frames, px
    changing_px     rms of errors of a centre that change from frame to frame, px
    outline_px      rms of errors of the entries of an ellipse's matrix, px
    largest_misfit  largest accepted reduced chi-square of a fit
    largest_light   light that rises across the stickers is fitted if it would move the pose by more
                    than this (squared movement in units of the pose's noise)
    known           True if print is not perfect, and its sizes are known
    """

    constant_px: float = 0.0
    changing_px: float = 0.0
    outline_px: float = 0.0
    largest_misfit: float = FitLimits.largest_misfit
    largest_light: float = LARGEST_LIGHT
    known: bool = False

    def constant_covariances(self, rig: StereoRig, points: Array) -> Array:
        """Return the covariances (n, 3, 3) of points (n, 3) due to constant errors of centres.

        The points are in the camera frame, m.
        """
        slopes = rig.derivatives(points)[0].reshape(2, len(points), 2, 3)
        information = np.einsum("cnki,cnkj->nij", slopes, slopes)
        return np.asarray(self.constant_px**2 * np.linalg.inv(information))


def centre_errors_px(file: SensorFile, radius_px: float) -> tuple[float, float]:
    """Return the rms of constant and of changing errors of centres due to print, px.

    ``radius_px`` is the radius of a sticker in the image. Light that rises across the sticker is
    assumed to be fitted.
    """
    sizes = print_sizes(file)
    errors = np.array([sizes.unevenness, sizes.outline * radius_px])
    changing = CHANGING_BLURRED if file.lens.psf_px > 0.0 else CHANGING
    return float(np.linalg.norm(CONSTANT * errors)), float(np.linalg.norm(changing * errors))


def print_allowance(
    file: SensorFile, noise: CameraNoise, radius_px: float, fit_size: int
) -> PrintAllowance:
    """Return the allowance of an estimator for the print that a sensor file states.

    ``radius_px`` is the radius of a sticker in the image, and ``fit_size`` the side of the fitted
    part of a window, px. If print is perfect or its sizes are not known, nothing is allowed for.
    With uneven print or outlines, light that rises across stickers is always fitted, because its
    effect is similar.
    """
    if file.print.is_perfect or not file.print.known:
        return PrintAllowance()
    sizes = print_sizes(file)
    errors = np.array([sizes.unevenness, sizes.outline * radius_px])
    rim = sizes.thickness * sizes.rim * radius_px
    bright = float(noise.mean_grey(np.array(file.stickers.sticker_level / 255.0)))
    area_fraction = np.pi * radius_px**2 / fit_size**2
    # Squared differences from the model on the sticker, and on its rim of one pixel width.
    misfit = area_fraction * (errors[0] ** 2 + 2.0 / radius_px * (errors[1] ** 2 + rim**2))
    misfit *= (bright - noise.black_level) ** 2 / float(noise.variance(np.array(bright)))
    return PrintAllowance(
        *centre_errors_px(file, radius_px),
        float(np.linalg.norm(np.multiply(SHAPE, [*errors, rim]))),
        FitLimits.largest_misfit + MISFIT_SPREAD * misfit,
        0.0 if errors.any() else LARGEST_LIGHT,
        known=True,
    )
