"""Images as the estimator gets them: whole stereo frames, or windows read out of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import require_kind
from cmmsim.errors import ShapeError
from cmmsim.radiometry.noise import GreyImage, cut_windows

Windows = GreyImage | NDArray[np.float64]


@dataclass(frozen=True)
class StereoFrame:
    """left and right: grey images (height, width) taken at the same time, uint8, or uint16 of more than 8 bit."""

    left: GreyImage
    right: GreyImage

    def __post_init__(self) -> None:
        for name in ("left", "right"):
            image = getattr(self, name)
            if not isinstance(image, np.ndarray):
                raise ShapeError(f"the {name} image must be an array (height, width), got {type(image).__name__}")
            if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
                raise ShapeError(
                    f"the {name} image must be (height, width) uint8 or uint16, got {image.shape} {image.dtype}"
                )

    def __repr__(self) -> str:
        height, width = self.left.shape
        return f"StereoFrame(two images of {width} x {height} px, {self.left.dtype})"


@runtime_checkable
class StereoImages(Protocol):
    """One exposure of two cameras that can be read whole or in parts."""

    def full(self) -> StereoFrame:
        """Both whole images."""

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x, y)."""


class FrameImages:
    """Windows cut out of a stereo frame; outside of the image they repeat its edge."""

    def __init__(self, frame: StereoFrame) -> None:
        self._frame = frame

    def full(self) -> StereoFrame:
        """Both whole images."""
        return self._frame

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x, y)."""
        sides = zip((self._frame.left, self._frame.right), corners, strict=True)
        return np.stack([cut_windows(image, first, size) for image, first in sides])


def readable(images: StereoImages | StereoFrame) -> StereoImages:
    """Images that can be read in parts, those of a whole frame too. Raises CmmError for anything else."""
    if isinstance(images, StereoFrame):
        return FrameImages(images)
    require_kind(images, StereoImages, "images must be a StereoFrame(left, right) or what sensor.look returns")
    return images
