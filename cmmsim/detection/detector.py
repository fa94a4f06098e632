"""Contract of all detectors of sticker centres: their input, their result, and the choice of
one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DETECTORS, find
from cmmsim.checks import finite_array, require_kind
from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise


@dataclass(frozen=True)
class FitLimits:
    """Limits within which a window counts as one whole sticker.

    ``smallest_contrast`` is in grey values. ``largest_misfit`` limits the reduced chi-square, for
    noise of a grey value and more.
    """

    smallest_contrast: float = 40.0
    largest_misfit: float = 1.8


@dataclass(frozen=True)
class DetectedCentres:
    """Ellipse centres in n windows, in px of the whole image.

    ``centres`` (n, 2) have ``covariances`` (n, 2, 2) px², which are the effect of pixel noise to
    first order. ``good`` (n,) says whether a window holds one whole bright spot. Values of other
    windows are finite but mean nothing. A detector may also state ``shapes`` (n, 2, 2) px,
    ``shape_covariances`` (n, 3, 3) px² of A_xx, A_xy, A_yy, and ``misfits`` (n,), the reduced
    chi-square of the grey values.
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
        """Return the result with windows ``at`` (m,) replaced by those of ``which`` (k,) of other
        windows.

        It states what both results state.
        """
        changed: dict[str, Any] = {}
        for name, own in vars(self).items():
            theirs = getattr(others, name)
            changed[name] = None if own is None or theirs is None else own.copy()
            if changed[name] is not None:
                changed[name][at] = theirs[which]
        return replace(self, **changed)


def no_centres() -> DetectedCentres:
    """Return the result for no windows."""
    return DetectedCentres(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class SpotWindows:
    """Windows with one bright spot each, and what is known of them.

    ``windows`` (n, h, h) are grey values, and ``corners`` (n, 2) the pixel (x, y) of the whole
    image that each begins at. ``fit_size`` is the side in px of the part around the bright spot
    that is looked at. ``psf_px`` is the sigma of the Gaussian point spread. ``smears`` (n, 2) px
    are the movements of the spots during the exposure; centres are for its middle.
    """

    windows: NDArray
    corners: NDArray[np.integer]
    noise: CameraNoise
    fit_size: int
    limits: FitLimits = field(default_factory=FitLimits)
    psf_px: float = 0.0
    smears: Array | None = None


Detect = Callable[[SpotWindows], DetectedCentres]
"""Ellipse centres in windows with one bright spot each."""


@dataclass(frozen=True)
class Detector:
    """Detector of sticker centres.

    ``bias_px`` is the rms error of a centre without noise at the built-in sensors' radius (3.8 px,
    45 degrees, sharp images). It differs from place to place within a pixel, so it acts like noise
    that ``detect`` does not state. ``margin_px`` is the additional width of a window on each side,
    against that of the maximum-likelihood fit.
    """

    name: str
    detect: Detect
    bias_px: float = 0.0
    margin_px: int = 0


@lru_cache
def find_detector(name: str) -> Detector:
    """Return the detector of a built-in name, or of ``module:name``.

    The latter is a Detector, or a ``Detect`` function that may carry ``bias_px`` and ``margin_px``.
    Raises UnknownOptionError with the valid names, and CmmError for what cannot be imported or
    called.
    """
    return find("detector", name, DETECTORS, Detector, _check_centres)


def _check_centres(part: str, found: object, spots: SpotWindows) -> None:
    """Raise CmmError unless a detector of a user's own has returned what it should."""
    require_kind(found, DetectedCentres, f"{part} must return DetectedCentres")
    count = len(spots.windows)
    for name, shape in (("centres", (count, 2)), ("covariances", (count, 2, 2))):
        finite_array(getattr(found, name), shape, f"{part} must return finite {name} {shape}")
    good = np.asarray(getattr(found, "good"))  # noqa: B009
    if good.dtype != bool or good.shape != (count,):
        raise CmmError(f"{part} must return good ({count},) of bool, got {good.dtype} {good.shape}")
