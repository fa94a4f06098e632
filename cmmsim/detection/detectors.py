"""The detectors of sticker centres behind one contract, and which of them is taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.detected_centres import DetectedCentres
from cmmsim.detection.dual_conic import EDGE_PX, detect_by_dual_conic
from cmmsim.detection.ellipse_fit import FitLimits, fit_ellipses
from cmmsim.detection.grey_centroid import detect_by_centroid
from cmmsim.errors import UnknownOptionError
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise


class DetectWindows(Protocol):
    """Ellipse centres in n windows with one bright spot each."""

    def __call__(
        self,
        windows: NDArray,
        corners: NDArray[np.integer],
        noise: CameraNoise,
        fit_size: int,
        limits: FitLimits | None = None,
        psf_px: float = 0.0,
        smears: Array | None = None,
    ) -> DetectedCentres:
        """Detect.

        Parameters: windows (n, h, h) grey values; corners (n, 2) the full-image pixel (x, y) of each window's first
        pixel; noise: the camera's noise; fit_size: side in px of the part around the bright spot that is looked at;
        limits: when a window counts as one whole sticker; psf_px: sigma of the Gaussian point spread; smears
        (n, 2) px: how far each spot moves during the exposure, for whose middle the centres are.
        """


@dataclass(frozen=True)
class Detector:
    """name; detect; bias_px: rms error of a centre without noise, at the built-in sensors' radius (3.8 px, 45 degrees,
    sharp images). It differs from place to place within a pixel, so it acts like noise that detect does not state.
    margin_px: how much wider than for the maximum-likelihood fit a window must be on each side."""

    name: str
    detect: DetectWindows
    bias_px: float
    margin_px: int = 0


def detect_by_maximum_likelihood(
    windows: NDArray,
    corners: NDArray[np.integer],
    noise: CameraNoise,
    fit_size: int,
    limits: FitLimits | None = None,
    psf_px: float = 0.0,
    smears: Array | None = None,
) -> DetectedCentres:
    """Centres of the maximum-likelihood fit of a blurred ellipse. Parameters as of ``DetectWindows``."""
    fits = fit_ellipses(windows, corners, noise, fit_size, limits, psf_px=psf_px, smears=smears)
    return DetectedCentres(fits.centres, fits.covariances, fits.good, fits.shapes, fits.shape_covariances, fits.misfit)


DETECTORS = {
    d.name: d
    for d in (
        Detector("maximum_likelihood", detect_by_maximum_likelihood, 0.0),
        Detector("dual_conic", detect_by_dual_conic, 0.004, EDGE_PX),
        Detector("grey_centroid", detect_by_centroid, 0.009),
    )
}
DEFAULT_DETECTOR = "maximum_likelihood"


def find_detector(name: str) -> Detector:
    """The detector of that name. Raises UnknownOptionError with the valid names."""
    if name not in DETECTORS:
        raise UnknownOptionError("detector", name, DETECTORS)
    return DETECTORS[name]
