"""Images with a fault laid over them: marks in either image, or both images swapped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import require_kind
from cmmsim.fault_marks import Mark, paint
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.images import StereoFrame, StereoImages, Windows, readable
from cmmsim.radiometry.noise import CameraNoise


@dataclass(frozen=True)
class Fault:
    """kind: its name; marks: laid over the images; swapped: left image for right; obstacles: bodies of
    ``fault_bodies`` that stand before the platform, name -> base_from_body (4,4)."""

    kind: str
    marks: tuple[Mark, ...] = ()
    swapped: bool = False
    obstacles: Mapping[str, Array] = field(default_factory=dict)


class FaultyImages:
    """Images with a fault laid over them, a StereoFrame's or such as ``sensor.look`` returns; reads like those.

    Raises CmmError for arguments of another kind.
    """

    def __init__(
        self, images: StereoImages | StereoFrame, fault: Fault, noise: CameraNoise, rng: np.random.Generator
    ) -> None:
        images = readable(images)
        require_kind(fault, Fault, "a fault must be a Fault, such as FaultGenerator.draw returns")
        require_kind(noise, CameraNoise, "noise must be a CameraNoise, such as sensor.noise")
        require_kind(rng, np.random.Generator, "rng must be a generator, such as numpy.random.default_rng(1)")
        self._images, self._fault, self._noise, self._rng = images, fault, noise, rng

    def full(self) -> StereoFrame:
        """Both whole images."""
        frame = self._images.full()
        sides = (frame.right, frame.left) if self._fault.swapped else (frame.left, frame.right)
        origin = np.zeros((1, 2), dtype=int)
        return StereoFrame(*(self._spoilt(side, image[None], origin)[0] for side, image in enumerate(sides)))

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x, y)."""
        order = slice(None, None, -1) if self._fault.swapped else slice(None)
        windows = self._images.windows(corners[order], size)[order]
        return np.stack([self._spoilt(side, windows[side], corners[side]) for side in range(2)])

    def _spoilt(self, side: int, images: NDArray, corners: NDArray[np.int_]) -> NDArray:
        """Images (n, h, w) of one camera, with first pixels (n, 2), after its marks were laid over them."""
        marks = [m for m in self._fault.marks if m.side == side]
        if not marks:
            return images
        grey = images.astype(float)
        for part, corner in zip(grey, corners, strict=True):
            for mark in marks:
                paint(part, corner, mark, self._noise, self._rng)
        grey = np.clip(grey, 0.0, float(self._noise.white_level))
        return grey if images.dtype.kind == "f" else np.rint(grey).astype(images.dtype)
