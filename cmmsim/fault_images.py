"""Images with a fault laid over them: marks painted into their grey values, or both images swapped.

Marks are opaque discs and plates, added light, and whole images of one radiance. They are painted
over grey values that already contain noise. If a mark hides the fraction s of a pixel, the pixel's
new light is (1 - s) of its old light plus s of the mark's light. Noise is then added such that the
pixel's variance equals the camera's variance at the new mean.
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

# Radiance below which added light is not drawn.
FAINTEST = 1e-4


class Mark(Protocol):
    """Mark in one image."""

    @property
    def side(self) -> int:
        """Image that the mark lies in: 0 left, 1 right."""

    def box(self) -> tuple[float, float, float, float]:
        """Return the smallest x, y and the largest x, y that the mark reaches, px of the image."""

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """Return the hidden fraction (h, w) and the added radiance (h, w) of each pixel.

        The pixels are the part of the image that begins at pixel ``corner`` (x, y) and has the
        given shape.
        """


@dataclass(frozen=True)
class DiscMark:
    """Opaque ellipse.

    It has a centre (2,) px of the image, and a radiance 0 to 1. Its symmetric shape matrix (2, 2)
    px maps the unit circle to the rim relative to the centre.
    """

    side: int
    centre: Array
    shape: Array
    radiance: float

    def box(self) -> tuple[float, float, float, float]:
        """See ``Mark``."""
        return _box(self.centre, np.linalg.norm(self.shape, axis=1) + 1.0)

    def light(self, corner: NDArray[np.int_], shape: tuple[int, int]) -> tuple[Array, Array]:
        """See ``Mark``."""
        hidden = coverage((self.centre - corner)[None], self.shape[None], max(shape))[0][
            0, : shape[0], : shape[1]
        ]
        return hidden, hidden * self.radiance


@dataclass(frozen=True)
class PlateMark:
    """Opaque rectangle with edges that are blurred over one pixel.

    It has a centre (2,) px, half sides (2,) px, and a radiance 0 to 1. The first side has an
    ``angle`` in rad from the x axis towards the y axis.
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
        hidden = inside[0] * inside[1]
        return hidden, hidden * self.radiance


@dataclass(frozen=True)
class GlintMark:
    """Added light: a Gaussian core, and a straight tail as wide as the core.

    centre     (2,), px
    peak       radiance of the core at the centre; radiance above 1 can saturate
    core       standard deviation of the core, px
    tail_peak  radiance of the tail at the centre
    tail       distance over which the tail's radiance falls by the factor e, px
    angle      direction of the tail, which lies on both sides of the centre, rad
    """

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
    """Whole image of one radiance.

    The radiance is 0 for a dropped frame or a covered lens, and above 1 for a saturated frame.
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
    """Lay a mark over a part of an image, in place.

    ``grey`` (h, w) are the part's grey values as floats. The part begins at pixel ``corner`` (x, y)
    of the image.
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
        contained = (1.0 - hidden[touched]) ** 2 * noise.variance(part[touched])
        missing = np.maximum(noise.variance(new) - contained, 0.0)
        new = new + np.sqrt(missing) * rng.standard_normal(len(new))
    part[touched] = new


def _box(centre: Array, reach: Array | float) -> tuple[float, float, float, float]:
    """Return the smallest x, y and the largest x, y within ``reach`` px around a centre (2,)."""
    return (*(centre - reach), *(centre + reach))


def _offsets(
    centre: Array, corner: NDArray[np.int_], shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Return the offsets in x (1, w) and in y (h, 1) of a part's pixels from a centre, px."""
    x = corner[0] + np.arange(shape[1]) - centre[0]
    y = corner[1] + np.arange(shape[0]) - centre[1]
    return x[None, :], y[:, None]


@dataclass(frozen=True)
class Fault:
    """Fault of a stereo frame.

    ``kind`` is one of ``FaultGenerator.kinds``. If ``swapped`` is True, the left and the right
    image are exchanged. ``marks`` are then laid over the images. ``obstacles`` are transforms
    base_from_body (4, 4) of bodies in front of the platform, by their names in ``fault_bodies``.

    Examples
    --------
    >>> Fault("one_camera_dark", marks=(FillMark(0, 0.0),))
    Fault('one_camera_dark', 1 marks, 0 obstacles)
    """

    kind: str
    marks: tuple[Mark, ...] = ()
    swapped: bool = False
    obstacles: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Fault({self.kind!r}, {len(self.marks)} marks, {len(self.obstacles)} obstacles)"


class FaultyImages:
    """Images with a fault laid over them. They are read like images without a fault.

    Parameters
    ----------
    images : StereoFrame or images of ``sensor.look``
        Images without the fault.
    fault : Fault
        Fault that is laid over them.
    noise : CameraNoise
        Noise of the camera, such as ``sensor.noise``.
    rng : numpy.random.Generator
        Generator of the marks' noise, which is drawn anew at each reading of the images.

    Raises
    ------
    CmmError
        If an argument is of another type.

    Examples
    --------
    >>> from cmmsim.radiometry.noise import CameraNoise
    >>> grey = np.full((60, 80), 90, dtype=np.uint8)
    >>> covered = Fault("one_camera_dark", marks=(FillMark(0, 0.0),))
    >>> noise = CameraNoise(2e4, 0.01, 10.0, 3e4, 0.0)
    >>> images = FaultyImages(StereoFrame(grey, grey), covered, noise, np.random.default_rng(0))
    >>> seen = images.full()
    >>> bool(seen.left.max() < 20), int(seen.right.max())
    (True, 90)
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
        """Return both whole images."""
        frame = self._images.full()
        sides = (frame.right, frame.left) if self._fault.swapped else (frame.left, frame.right)
        origin = np.zeros((1, 2), dtype=int)
        return StereoFrame(
            *(self._spoilt(side, image[None], origin)[0] for side, image in enumerate(sides))
        )

    def windows(self, corners: NDArray[np.int_], size: int) -> Windows:
        """Return the grey values (2, n, size, size) of windows.

        ``corners`` (2, n, 2) are the first pixels of the windows, as (x, y).
        """
        order = slice(None, None, -1) if self._fault.swapped else slice(None)
        windows = self._images.windows(corners[order], size)[order]
        return np.stack([self._spoilt(side, windows[side], corners[side]) for side in range(2)])

    def _spoilt(self, side: int, images: NDArray, corners: NDArray[np.int_]) -> NDArray:
        """Return n parts (n, h, w) of one image with the marks over them.

        ``corners`` (n, 2) are the first pixels of the parts, as (x, y).
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
