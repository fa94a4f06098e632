"""The contract of all detectors of sticker centres: what they are given, what they hand back, and
which is taken.
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
    """When a window counts as one whole sticker.

    smallest_contrast in grey values; largest_misfit of the reduced chi-square, for noise of a grey
    value and more.
    """

    smallest_contrast: float = 40.0
    largest_misfit: float = 1.8


@dataclass(frozen=True)
class DetectedCentres:
    """Ellipse centres in n windows, in full-image px.

    centres (n,2); covariances (n,2,2) px², what the pixel noise does to the centres to first order;
    good (n,) whether the window holds one whole bright spot. shapes (n,2,2) px and
    shape_covariances (n,3,3) px² of A_xx, A_xy, A_yy where a detector states them, as misfits (n,),
    the reduced chi-square of the grey values. Values of windows that are not good are finite but
    mean nothing.
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
        """The same, but in windows ``at`` (m,) those of ``which`` (k,) of other windows; states
        what both state.
        """
        changed: dict[str, Any] = {}
        for name, own in vars(self).items():
            theirs = getattr(others, name)
            changed[name] = None if own is None or theirs is None else own.copy()
            if changed[name] is not None:
                changed[name][at] = theirs[which]
        return replace(self, **changed)


def no_centres() -> DetectedCentres:
    """The result for no windows."""
    return DetectedCentres(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class SpotWindows:
    """n windows with one bright spot each, and what is known of them.

    windows (n,h,h) grey values; corners (n,2) the full-image pixel (x, y) of each window's first
    pixel; noise: the camera's noise; fit_size: side in px of the part around the bright spot that
    is looked at; limits: when a window counts as one whole sticker; psf_px: sigma of the Gaussian
    point spread; smears (n,2) px: how far each spot moves during the exposure, for whose middle the
    centres are.
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
    """name; detect; bias_px: rms error of a centre without noise, at the built-in sensors' radius
    (3.8 px, 45 degrees, sharp images). It differs from place to place within a pixel, so it acts
    like noise that detect does not state. margin_px: how much wider than for the maximum-likelihood
    fit a window must be on each side."""

    name: str
    detect: Detect
    bias_px: float = 0.0
    margin_px: int = 0


@lru_cache
def find_detector(name: str) -> Detector:
    """The detector of a built-in name, or of ``module:name``: a Detector, or a ``Detect`` function.

    A function may carry its own ``bias_px`` and ``margin_px``. Raises UnknownOptionError with the
    valid names, CmmError for what cannot be imported or called.
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
