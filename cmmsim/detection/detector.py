"""Interface of all detectors of sticker centres: input, result, and selection by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DETECTORS, find
from cmmsim.checks import finite_array, require_kind
from cmmsim.detection.own_centres import likely_fault
from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise


@dataclass(frozen=True)
class FitLimits:
    """Limits for accepting the content of a window as one whole sticker.

    ``smallest_contrast`` is in grey values. ``largest_misfit`` is the limit of the reduced
    chi-square, which ``ellipse_fit.largest_misfits`` raises for weak noise.
    """

    smallest_contrast: float = 40.0
    largest_misfit: float = 1.8


@dataclass(frozen=True)
class DetectedCentres:
    """Ellipse centres in n windows.

    centres            (n, 2), px of the whole image
    covariances        (n, 2, 2), effect of pixel noise on the centres, to first order, px²
    good               (n,), True if a window contains one whole bright spot; the values of other
                       windows are finite but meaningless
    shapes             (n, 2, 2), symmetric matrices A of the ellipses, px; optional
    shape_covariances  (n, 3, 3), of A_xx, A_xy, A_yy, px²; optional
    misfits            (n,), reduced chi-square of the grey values; optional
    """

    centres: Array
    covariances: Array
    good: NDArray[np.bool_]
    shapes: Array | None = None
    shape_covariances: Array | None = None
    misfits: Array | None = None

    def with_others(
        self, at: NDArray[np.int_], others: DetectedCentres, which: NDArray[np.bool_]
    ) -> Self:
        """Return the result with windows ``at`` (m,) taken from another result.

        ``which`` (k,) is a mask of the windows to take from the k windows of ``others``. An
        optional array is None if one of the results lacks it.
        """
        changed: dict[str, Any] = {}
        for name, old in vars(self).items():
            other = getattr(others, name)
            changed[name] = None if old is None or other is None else old.copy()
            if changed[name] is not None:
                changed[name][at] = other[which]
        return replace(self, **changed)


def no_centres() -> DetectedCentres:
    """Return the result for an empty set of windows."""
    return DetectedCentres(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class SpotWindows:
    """Windows that contain one bright spot each, and the known properties of their images.

    windows   (n, h, h), grey values
    corners   (n, 2), pixels (x, y) of the whole image at which the windows begin
    noise     noise of the camera
    fit_size  side of the part around the bright spot that is used, px
    limits    limits for accepting a spot
    psf_px    standard deviation of the Gaussian point spread
    smears    (n, 2), movements of the spots during the exposure, px; None for spots at rest

    The centres to be found are those at the middle of the exposure.
    """

    windows: NDArray
    corners: NDArray[np.integer]
    noise: CameraNoise
    fit_size: int
    limits: FitLimits = field(default_factory=FitLimits)
    psf_px: float = 0.0
    smears: Array | None = None


Detect = Callable[[SpotWindows], DetectedCentres]
"""Function that finds the ellipse centres in windows with one bright spot each."""


@dataclass(frozen=True)
class Detector:
    """Detector of sticker centres.

    ``bias_px`` is the rms error of a centre per axis in sharp noise-free images of stickers of 3.8
    px radius that are tilted by 45 degrees, as in the built-in sensors. The error varies with the
    position within a pixel, so it acts like additional noise. The covariances of ``detect`` do not
    include it. ``margin_px`` is the width on each side by which windows must be larger than those
    of the maximum-likelihood fit.
    """

    name: str
    detect: Detect
    bias_px: float = 0.0
    margin_px: int = 0


@lru_cache
def find_detector(name: str) -> Detector:
    """Return the detector with a built-in name, or the detector ``module:name``.

    ``module:name`` names a Detector, or a ``Detect`` function with optional attributes ``bias_px``
    and ``margin_px``. Raises UnknownOptionError with the valid names, and CmmError if
    ``module:name`` is not allowed to run, or cannot be imported or called.
    """
    return find("detector", name, DETECTORS, Detector, _check_centres)


ROUNDING = 1e-9  # largest negative eigenvalue that counts as rounding, as a fraction of the other

_WARNED: set[str] = set()  # users' detectors that this process has already warned of


def _check_centres(part: str, result: object, spots: SpotWindows) -> None:
    """Raise CmmError if the result of a user's detector has a wrong type, shape or value.

    Warn once if all centres have the same offset.
    """
    require_kind(result, DetectedCentres, f"{part} must return DetectedCentres")
    count = len(spots.windows)
    for name, shape in (("centres", (count, 2)), ("covariances", (count, 2, 2))):
        finite_array(getattr(result, name), shape, f"{part} must return finite {name} {shape}")
    good = np.asarray(getattr(result, "good"))  # noqa: B009
    if good.dtype != bool or good.shape != (count,):
        raise CmmError(f"{part} must return good ({count},) of bool, got {good.dtype} {good.shape}")
    found = np.asarray(result.covariances)[good]  # type: ignore[attr-defined]
    least, largest = np.linalg.eigvalsh(found).T
    if (least < -ROUNDING * np.abs(largest)).any():
        raise CmmError(
            f"{part} must return covariances without a negative eigenvalue where good, got "
            f"{least.min():.3g} px²"
        )
    centres = np.asarray(result.centres)[good]  # type: ignore[attr-defined]
    fault, certain = likely_fault(spots.windows[good], spots.corners[good], centres)
    if fault and not certain and part not in _WARNED:
        _WARNED.add(part)
        warnings.warn(
            f"{part}: {fault} from the bright spots in their windows; (0, 0) is the middle of the "
            "first pixel of the whole image",
            stacklevel=2,
        )
    if certain:
        raise CmmError(
            f"{part} must return centres (x, y) in px of the whole image, but those of "
            f"{len(centres)} windows are far from the bright spots in them: {fault}"
        )
