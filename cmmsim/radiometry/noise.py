"""Camera noise after the linear model of EMVA 1288.

Radiance (0 to 1) becomes electrons. Shot noise, dark noise and differences from pixel to pixel are
added. The gain K turns electrons into grey values, which are clipped and rounded. Shot noise is
drawn as a normal variable of the Poisson variance.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

BIT_DEPTHS = (8, 10, 12)
# Terms of a series, which leave 0.002 of 0.25 without noise.
ROUNDING_TERMS = 50
# Grey values squared: beyond, rounding_excess is 1 to 1e-11.
NO_SWING = 1.5
# From here on the mean of exposures is drawn at once.
MANY_EXPOSURES = 30
T = TypeVar("T", bound=np.generic)
Singles = NDArray[np.float32]
GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


def cut_windows(image: NDArray[T], corners: NDArray[np.int_], size: int) -> NDArray[T]:
    """Return windows (k, size, size) of an image (height, width) with first pixels (k, 2) as (x,
    y).

    Outside of the image they repeat its edge.
    """
    ticks = np.arange(size)
    rows = np.clip(corners[:, 1, None] + ticks, 0, image.shape[0] - 1)
    columns = np.clip(corners[:, 0, None] + ticks, 0, image.shape[1] - 1)
    return image[rows[:, :, None], columns[:, None, :]]


@dataclass(frozen=True)
class FixedPattern:
    """Differences from pixel to pixel of one camera, the same in every image (EMVA 1288: PRNU and
    DSNU).

    ``sensitivity`` is the sensitivity of each pixel relative to the mean, and ``offset`` its signal
    in the dark, e-. Both are arrays of one shape.
    """

    sensitivity: NDArray[np.float32]
    offset: NDArray[np.float32]

    def windows(self, corners: NDArray[np.int_], size: int) -> "FixedPattern":
        """Return the pattern (k, size, size) in windows as of ``cut_windows``."""
        return FixedPattern(
            *(cut_windows(values, corners, size) for values in (self.sensitivity, self.offset))
        )


def draw_pattern(
    shape: tuple[int, int], prnu: float, dsnu: float, rng: np.random.Generator
) -> FixedPattern:
    """Draw the pattern of a camera with ``shape`` (height, width).

    It is white and normal, with relative standard deviation ``prnu``, and ``dsnu`` e-.
    """
    sensitivity = 1.0 + np.float32(prnu) * rng.standard_normal(shape, dtype=np.float32)
    offset = np.float32(dsnu) * rng.standard_normal(shape, dtype=np.float32)
    for values in (sensitivity, offset):
        values.setflags(write=False)
    return FixedPattern(sensitivity, offset)


@dataclass(frozen=True)
class CameraNoise:
    """EMVA 1288 figures of one camera.

    electrons_at_white  electrons at radiance 1 after one exposure, e-
    gain                system gain K, grey values per e-
    dark_noise          temporal noise in the dark, e- rms
    full_well           saturation capacity, e-
    black_level         grey value at no light
    enabled             False: no noise at all; the mean grey value is still rounded
    bit_depth           of the grey values: 8, 10 or 12; images of more than 8 are uint16
    prnu                standard deviation of the pixels' sensitivity, relative to its mean
    dsnu                standard deviation of the pixels' offset, e-
    frames              exposures averaged in each grey value: they divide the temporal noise, but
                        not the pattern
    """

    electrons_at_white: float
    gain: float
    dark_noise: float
    full_well: float
    black_level: float
    enabled: bool = True
    bit_depth: int = 8
    prnu: float = 0.0
    dsnu: float = 0.0
    frames: int = 1

    def __post_init__(self) -> None:
        if min(self.electrons_at_white, self.gain, self.full_well) <= 0.0 or self.dark_noise < 0.0:
            raise CmmError(f"camera noise needs positive electrons, gain and full well, got {self}")
        if min(self.prnu, self.dsnu) < 0.0 or self.bit_depth not in BIT_DEPTHS or self.frames < 1:
            raise CmmError(
                f"camera noise needs prnu and dsnu >= 0, bit_depth of {BIT_DEPTHS} and frames >= "
                f"1, got {self}"
            )

    @property
    def white_level(self) -> int:
        """Largest grey value."""
        return int(2**self.bit_depth - 1)

    @property
    def image_type(self) -> np.dtype:
        """Type of the grey values."""
        return np.dtype(np.uint8 if self.bit_depth == 8 else np.uint16)

    def mean_grey(self, radiance: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the expected grey values of radiance 0 to 1."""
        electrons = np.minimum(radiance * self.electrons_at_white, self.full_well)
        return self.black_level + self.gain * electrons

    def variance(self, mean_grey: Array) -> Array:
        """Return the variance of a grey value with this mean: shot, dark, pattern and rounding
        noise.
        """
        electrons = np.maximum((mean_grey - self.black_level) / self.gain, 0.0)
        constant, linear, quadratic = self.variance_coefficients
        return constant + electrons * (linear + electrons * quadratic)

    def rounding_excess(self, mean_grey: Array) -> Array:
        """Return the largest variance of grey values with about this mean, over their usual one.

        It is 1 with noise of a grey value, and up to 3 with little noise. With little noise, the
        noise decides whether a mean half-way between two numbers is rounded up or down.

        The variance of a rounded normal variable whose mean lies half-way between two numbers comes
        from the Fourier series of the rounding error: s² + 1/12 + sum over k of exp(-2 pi² k² s²)
        (4 s² + 1 / (pi k)²). Over all means it is s² + 1/12, but the pixels of an even ground share
        theirs.
        """
        usual = replace(self, frames=1).variance(np.asarray(mean_grey, dtype=float))
        if np.all(usual > NO_SWING):
            return np.ones(usual.shape)
        spread = usual[..., None] - 1.0 / 12.0
        k = np.arange(1, ROUNDING_TERMS + 1)
        swing = np.exp(-2.0 * np.pi**2 * k**2 * spread) * (4.0 * spread + 1.0 / (np.pi * k) ** 2)
        return np.asarray(1.0 + swing.sum(axis=-1) / usual)

    @property
    def variance_coefficients(self) -> tuple[float, float, float]:
        """Variance of a grey value as a polynomial in its electrons: constant, linear,
        quadratic.
        """
        # A mean over exposures divides the temporal noise; the pattern stays.
        temporal = self.gain**2 / self.frames
        pattern = self.gain**2
        return (
            temporal * self.dark_noise**2 + pattern * self.dsnu**2 + 1.0 / (12.0 * self.frames),
            temporal,
            pattern * self.prnu**2,
        )

    def expose(
        self,
        radiance: NDArray[np.float32],
        rng: np.random.Generator,
        pattern: FixedPattern | None = None,
    ) -> GreyImage:
        """Take one exposure of a radiance image (float32, 0 to 1).

        ``pattern`` has the same shape, where pixels differ.
        """
        if not self.enabled:
            grey = np.rint(np.clip(self.mean_grey(radiance), 0.0, float(self.white_level)))
            return np.asarray(grey.astype(self.image_type))
        # Late, as numba takes time to import.
        from cmmsim.radiometry.noise_kernels import expose_pixels

        grey = np.empty(radiance.shape, dtype=self.image_type)
        expose_pixels(*self._lit(radiance, rng, pattern), grey.ravel())
        return grey

    def mean_of_exposures(
        self,
        radiance: NDArray[np.float32],
        rng: np.random.Generator,
        frames: int,
        pattern: FixedPattern | None = None,
    ) -> Array:
        """Return the mean grey values (float64) of independent exposures of a scene that stands
        still.

        Without noise the mean is not rounded: noisy exposures approach this mean, as their noise
        dithers the rounding. The mean of 30 and more is drawn at once, as one normal number a pixel
        with the mean and variance of the mean of rounded, clipped grey values. This neglects its
        shape: grey values are skewed only where they are clipped, and their mean goes in steps of
        1/frames, which do not show in sums over a sticker's pixels.
        """
        if not self.enabled:
            return np.clip(
                self.mean_grey(radiance.astype(np.float64)), 0.0, float(self.white_level)
            )
        if frames < MANY_EXPOSURES:
            return np.mean([self.expose(radiance, rng, pattern) for _ in range(frames)], axis=0)
        from cmmsim.radiometry.noise_kernels import average_pixels

        mean = np.empty(radiance.shape)
        average_pixels(*self._lit(radiance, rng, pattern), frames, mean.ravel())
        return mean

    def _lit(
        self, radiance: NDArray[np.float32], rng: np.random.Generator, pattern: FixedPattern | None
    ) -> tuple[Singles, Singles, Singles, Singles, Singles]:
        """Return the light on each pixel, a standard normal number each, and all else for the
        kernels.
        """
        normal = rng.standard_normal(radiance.shape, dtype=np.float32)
        none = np.empty(0, dtype=np.float32)
        differing = (
            (none, none)
            if pattern is None
            else (pattern.sensitivity.ravel(), pattern.offset.ravel())
        )
        return radiance.ravel(), normal.ravel(), self._figures, *differing

    @property
    def _figures(self) -> NDArray[np.float32]:
        """Electrons at white, full well, variance in the dark, black level, gain and largest grey
        value (6,).
        """
        return np.array(
            [
                self.electrons_at_white,
                self.full_well,
                self.dark_noise**2,
                self.black_level,
                self.gain,
                self.white_level,
            ],
            dtype=np.float32,
        )
