"""Images with a fault laid over them: marks painted into their grey values, or both images swapped.

Marks are opaque discs and plates, added light, and whole images of one level. They are laid over
grey values that already hold noise. A pixel of which a mark hides the share s keeps (1 - s) of what
it showed, gets s of the mark's light, and as much noise as makes its variance that of its new mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import require_kind
from cmmsim.geometry.disc_image import coverage
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages, Windows, readable

FAINTEST = 1e-4  # radiance below which added light is not drawn


class Mark(Protocol):
    """Something in one image: ``side`` 0 left, 1 right."""

    @property
    def side(self) -> int:
        """0 left, 1 right."""

    def box(self) -> tuple[float, float, float, float]:
        """First x, y and last x, y that the mark reaches, px of the image."""

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """Share hidden (h, w), 0 to 1, and light added (h, w), as radiance, of the part that begins
        at pixel ``corner`` (x, y)."""


@dataclass(frozen=True)
class DiscMark:
    """An opaque ellipse: centre (2,) px, shape A (2,2) px, symmetric, radiance 0 to 1."""

    side: int
    centre: Array
    shape: Array
    radiance: float

    def box(self) -> tuple[float, float, float, float]:
        """See ``Mark``."""
        return _box(self.centre, np.linalg.norm(self.shape, axis=1) + 1.0)

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """See ``Mark``."""
        share = coverage((self.centre - corner)[None], self.shape[None], max(shape))[0][
            0, : shape[0], : shape[1]
        ]
        return share, share * self.radiance


@dataclass(frozen=True)
class PlateMark:
    """An opaque rectangle with softly sampled edges: centre (2,) px, half sides (2,) px, angle rad,
    radiance 0 to 1.
    """

    side: int
    centre: Array
    half: Array
    angle: float
    radiance: float

    def box(self) -> tuple[float, float, float, float]:
        """See ``Mark``."""
        return _box(self.centre, float(np.hypot(*self.half)) + 1.0)

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """See ``Mark``."""
        x, y = _offsets(self.centre, corner, shape)
        cosine = np.cos(self.angle)
        sine = np.sin(self.angle)
        inside = [
            np.clip(0.5 + half - np.abs(x * along_x + y * along_y), 0.0, 1.0)
            for (along_x, along_y), half in zip(
                ((cosine, sine), (-sine, cosine)), self.half, strict=True
            )
        ]
        share = inside[0] * inside[1]
        return share, share * self.radiance


@dataclass(frozen=True)
class GlintMark:
    """Added light: a Gaussian core of ``peak`` radiance (above 1 saturates) and ``core`` px, and a
    straight tail of ``tail_peak`` that decays over ``tail`` px in direction ``angle``, rad, and is
    as wide as the core."""

    side: int
    centre: Array
    peak: float
    core: float
    tail_peak: float
    tail: float
    angle: float

    def box(self) -> tuple[float, float, float, float]:
        """See ``Mark``."""
        core = self.core * np.sqrt(2.0 * np.log(max(self.peak, self.tail_peak) / FAINTEST))
        return _box(
            self.centre, core + 1.0 + self.tail * np.log(max(self.tail_peak / FAINTEST, 1.0))
        )

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """See ``Mark``."""
        x, y = _offsets(self.centre, corner, shape)
        along = x * np.cos(self.angle) + y * np.sin(self.angle)
        across = y * np.cos(self.angle) - x * np.sin(self.angle)
        added = self.peak * np.exp(-0.5 * (x * x + y * y) / self.core**2)
        added += self.tail_peak * np.exp(
            -0.5 * (across / self.core) ** 2 - np.abs(along) / self.tail
        )
        return np.zeros(shape), added


@dataclass(frozen=True)
class FillMark:
    """The whole image shows one radiance: 0 a dropped frame or a covered lens, above 1 a saturated
    one.
    """

    side: int
    radiance: float

    def box(self) -> tuple[float, float, float, float]:
        """See ``Mark``."""
        return -np.inf, -np.inf, np.inf, np.inf

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """See ``Mark``."""
        return np.ones(shape), np.full(shape, self.radiance)


def paint(
    grey: Array, corner: NDArray[np.int_], mark: Mark, noise: CameraNoise, rng: np.random.Generator
) -> None:
    """Lay a mark over the grey values (h, w), float, of the part of an image that begins at pixel
    ``corner`` (x, y).
    """
    first_x, first_y, last_x, last_y = mark.box()
    height, width = grey.shape
    left, right = (int(np.clip(np.ceil(v - corner[0]), 0, width)) for v in (first_x, last_x + 1.0))
    top, bottom = (int(np.clip(np.ceil(v - corner[1]), 0, height)) for v in (first_y, last_y + 1.0))
    if left >= right or top >= bottom:
        return
    part = grey[top:bottom, left:right]
    hidden, light = mark.light(corner + np.array([left, top]), part.shape)
    touched = (hidden > 0.0) | (light > FAINTEST)
    kept = (1.0 - hidden[touched]) * (part[touched] - noise.black_level)
    radiance = np.maximum(kept / (noise.gain * noise.electrons_at_white), 0.0) + light[touched]
    new = np.asarray(noise.mean_grey(radiance), dtype=float)
    if noise.enabled:
        missing = noise.variance(new) - (1.0 - hidden[touched]) ** 2 * noise.variance(part[touched])
        new = new + np.sqrt(np.maximum(missing, 0.0)) * rng.standard_normal(len(new))
    part[touched] = new


def _box(centre: Array, reach: Array | float) -> tuple[float, float, float, float]:
    """First x, y and last x, y, ``reach`` px around a centre (2,)."""
    return (*(centre - reach), *(centre + reach))


def _offsets(
    centre: Array, corner: NDArray[np.int_], shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Distances along x (1, w) and y (h, 1) of a part's pixels from a centre."""
    x = corner[0] + np.arange(shape[1]) - centre[0]
    y = corner[1] + np.arange(shape[0]) - centre[1]
    return x[None, :], y[:, None]


@dataclass(frozen=True)
class Fault:
    """kind: its name; marks: laid over the images; swapped: left image for right; obstacles: bodies
    of ``fault_bodies`` that stand before the platform, name -> base_from_body (4,4)."""

    kind: str
    marks: tuple[Mark, ...] = ()
    swapped: bool = False
    obstacles: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Fault({self.kind!r}, {len(self.marks)} marks, {len(self.obstacles)} obstacles)"


class FaultyImages:
    """Images with a fault laid over them, a StereoFrame's or such as ``sensor.look`` returns; reads
    like those.

    Raises CmmError for arguments of another kind.
    """

    def __init__(
        self,
        images: StereoImages | StereoFrame,
        fault: Fault,
        noise: CameraNoise,
        rng: np.random.Generator,
    ) -> None:
        images = readable(images)
        require_kind(fault, Fault, "a fault must be a Fault, such as FaultGenerator.draw returns")
        require_kind(noise, CameraNoise, "noise must be a CameraNoise, such as sensor.noise")
        require_kind(
            rng, np.random.Generator, "rng must be a generator, such as numpy.random.default_rng(1)"
        )
        self._images = images
        self._fault = fault
        self._noise = noise
        self._rng = rng

    def full(self) -> StereoFrame:
        """Both whole images."""
        frame = self._images.full()
        sides = (frame.right, frame.left) if self._fault.swapped else (frame.left, frame.right)
        origin = np.zeros((1, 2), dtype=int)
        return StereoFrame(
            *(self._spoilt(side, image[None], origin)[0] for side, image in enumerate(sides))
        )

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Grey values (2, n, size, size) of windows with first pixels ``corners`` (2, n, 2) as (x,
        y).
        """
        order = slice(None, None, -1) if self._fault.swapped else slice(None)
        windows = self._images.windows(corners[order], size)[order]
        return np.stack([self._spoilt(side, windows[side], corners[side]) for side in range(2)])

    def _spoilt(self, side: int, images: NDArray, corners: NDArray[np.int_]) -> NDArray:
        """Images (n, h, w) of one camera, with first pixels (n, 2), after its marks were laid over
        them.
        """
        marks = [m for m in self._fault.marks if m.side == side]
        if not marks:
            return images
        grey = images.astype(float)
        for part, corner in zip(grey, corners, strict=True):
            for mark in marks:
                paint(part, corner, mark, self._noise, self._rng)
        grey = np.clip(grey, 0.0, float(self._noise.white_level))
        return grey if images.dtype.kind == "f" else np.rint(grey).astype(images.dtype)
