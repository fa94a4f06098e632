"""Camera noise after the linear model of EMVA 1288.

Radiance (0 to 1) is converted to electrons. Shot noise, dark noise and the fixed pattern of the
pixels are added. The gain K converts electrons to grey values above the black level, which are
clipped and rounded. Shot noise is normal, with the variance of the Poisson distribution.
"""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array

BIT_DEPTHS = (8, 10, 12, 14, 16)
# Number of terms of the series in rounding_excess. Without noise, the sum of the series is 1/6, and
# the terms that are left out add up to 0.002.
ROUNDING_TERMS = 50
# Variance, grey values squared, above which rounding_excess is 1 to within 1e-11.
NO_SWING = 1.5
# Smallest number of exposures whose mean is drawn directly. Fewer exposures are drawn one by one.
MANY_EXPOSURES = 30
T = TypeVar("T", bound=np.generic)
Singles = NDArray[np.float32]
GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


def cut_windows(image: NDArray[T], corners: NDArray[np.int_], size: int) -> NDArray[T]:
    """Return windows (k, size, size) of an image (height, width).

    ``corners`` (k, 2) are the first pixels (x, y) of the windows. Outside of the image, windows
    repeat the pixels at its edge.
    """
    ticks = np.arange(size)
    rows = np.clip(corners[:, 1, None] + ticks, 0, image.shape[0] - 1)
    columns = np.clip(corners[:, 0, None] + ticks, 0, image.shape[1] - 1)
    return image[rows[:, :, None], columns[:, None, :]]


@dataclass(frozen=True)
class FixedPattern:
    """Fixed pattern of one camera: differences between pixels that are the same in every image.

    ``sensitivity`` is the sensitivity of each pixel relative to the mean (PRNU in EMVA 1288).
    ``offset`` is the deviation of each pixel's dark signal, e- (DSNU). Both have the same shape.
    """

    sensitivity: NDArray[np.float32]
    offset: NDArray[np.float32]

    def windows(self, corners: NDArray[np.int_], size: int) -> "FixedPattern":
        """Return the pattern (k, size, size) in windows; see ``cut_windows``."""
        return FixedPattern(
            *(cut_windows(values, corners, size) for values in (self.sensitivity, self.offset))
        )


def draw_pattern(
    shape: tuple[int, int], prnu: float, dsnu: float, rng: np.random.Generator
) -> FixedPattern:
    """Draw the fixed pattern of a camera with ``shape`` (height, width).

    The pixels are independent and normal. ``prnu`` is the relative standard deviation of the
    sensitivities, and ``dsnu`` the standard deviation of the offsets, e-.
    """
    sensitivity = 1.0 + np.float32(prnu) * rng.standard_normal(shape, dtype=np.float32)
    offset = np.float32(dsnu) * rng.standard_normal(shape, dtype=np.float32)
    for values in (sensitivity, offset):
        values.setflags(write=False)
    return FixedPattern(sensitivity, offset)


@dataclass(frozen=True)
class CameraNoise:
    """Noise parameters of one camera after EMVA 1288.

    Raises CmmError for parameters that are out of range.

    electrons_at_white  electrons at radiance 1 after one exposure, e-
    gain                system gain K, grey values per e-
    dark_noise          temporal noise in the dark, e- rms
    full_well           saturation capacity, e-
    black_level         grey value without light
    enabled             False for no noise and no fixed pattern; the grey values of an exposure are
                        rounded nevertheless
    bit_depth           bits of a grey value, one of BIT_DEPTHS; above 8, images are uint16
    prnu                standard deviation of the pixels' sensitivities, relative to their mean
    dsnu                standard deviation of the pixels' offsets, e-
    frames              number of exposures averaged in each grey value; averaging reduces the
                        temporal noise, but not the fixed pattern
    inverted            True if stickers are dark; ``bright`` then subtracts grey values from the
                        largest one, so that stickers become bright
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
    inverted: bool = False

    def __post_init__(self) -> None:
        if min(self.electrons_at_white, self.gain, self.full_well) <= 0.0 or self.dark_noise < 0.0:
            raise CmmError(
                "camera noise needs positive electrons, gain and full well, and dark_noise >= 0, "
                f"got {self}"
            )
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
        """Return the expected grey values of radiance 0 to 1, before they are clipped to white."""
        electrons = np.minimum(radiance * self.electrons_at_white, self.full_well)
        return self.black_level + self.gain * electrons

    def variance(self, mean_grey: Array) -> Array:
        """Return the variances of grey values with the given means.

        Shot noise, dark noise, fixed pattern and rounding contribute to them, but clipping does
        not. The grey values are those that ``bright`` returns.
        """
        if self.inverted:
            mean_grey = self.white_level - mean_grey
        electrons = np.maximum((mean_grey - self.black_level) / self.gain, 0.0)
        constant, linear, quadratic = self.variance_coefficients
        return constant + electrons * (linear + electrons * quadratic)

    def bright(self, grey: NDArray[Any]) -> NDArray[Any]:
        """Return grey values of the same type in which stickers are bright."""
        return grey.dtype.type(self.white_level) - grey if self.inverted else grey

    @property
    def black_of_bright(self) -> float:
        """Grey value without light in images in which stickers are bright; see ``bright``."""
        return self.white_level - self.black_level if self.inverted else self.black_level

    def rounding_excess(self, mean_grey: Array) -> Array:
        """Return the ratio of the largest to the average variance of grey values near a mean.

        The values are those of a single exposure. The ratio is nearly 1 if the noise is at least
        one grey value, and up to 3 with less noise. With little noise, the variance of rounded
        values depends on their mean before rounding. It is largest half-way between two integers,
        because the noise then decides between rounding up and down.

        At such a mean, the Fourier series of the rounding error gives the variance of a rounded
        normal variable with the variance s²: s² + 1/12 + sum over k of exp(-2 pi² k² s²) (4 s² + 1
        / (pi k)²). The average variance over all means is s² + 1/12. The pixels of a uniform ground
        all have the same mean, so their variance can differ from this average.
        """
        average = replace(self, frames=1).variance(np.asarray(mean_grey, dtype=float))
        if np.all(average > NO_SWING):
            return np.ones(average.shape)
        unrounded = average[..., None] - 1.0 / 12.0
        k = np.arange(1, ROUNDING_TERMS + 1)
        swing = np.exp(-2.0 * np.pi**2 * k**2 * unrounded) * (
            4.0 * unrounded + 1.0 / (np.pi * k) ** 2
        )
        return np.asarray(1.0 + swing.sum(axis=-1) / average)

    @property
    def variance_coefficients(self) -> tuple[float, float, float]:
        """Coefficients of a grey value's variance as a polynomial in its electrons.

        The order is constant, linear, quadratic.
        """
        # averaging over exposures reduces the temporal noise, but not the fixed pattern
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
        """Return the grey values of one exposure of a radiance image (float32, 0 to 1).

        ``pattern`` is the fixed pattern of the same pixels, or None if they do not differ. Grey
        values are not inverted.
        """
        if not self.enabled:
            grey = np.rint(np.clip(self.mean_grey(radiance), 0.0, float(self.white_level)))
            return np.asarray(grey.astype(self.image_type))
        # Imported late, because importing numba takes time.
        from cmmsim.radiometry.noise_kernels import expose_pixels

        grey = np.empty(radiance.shape, dtype=self.image_type)
        expose_pixels(*self._kernel_arguments(radiance, rng, pattern), grey.ravel())
        return grey

    def mean_of_exposures(
        self,
        radiance: NDArray[np.float32],
        rng: np.random.Generator,
        frames: int,
        pattern: FixedPattern | None = None,
    ) -> Array:
        """Return the mean grey values (float64) of ``frames`` independent exposures at rest.

        The mean is not rounded, even if the noise is turned off: noise dithers the rounding, so the
        mean of many noisy exposures approaches the unrounded mean. The mean of 30 or more exposures
        is drawn directly, as one normal number per pixel with the correct mean and variance. Its
        distribution is only approximately right: clipped grey values are skewed, and the mean has
        steps of 1/frames. Neither matters for sums over the pixels of a sticker.
        """
        if not self.enabled:
            return np.clip(
                self.mean_grey(radiance.astype(np.float64)), 0.0, float(self.white_level)
            )
        if frames < MANY_EXPOSURES:
            return np.mean([self.expose(radiance, rng, pattern) for _ in range(frames)], axis=0)
        from cmmsim.radiometry.noise_kernels import average_pixels

        mean = np.empty(radiance.shape)
        average_pixels(*self._kernel_arguments(radiance, rng, pattern), frames, mean.ravel())
        return mean

    def _kernel_arguments(
        self, radiance: NDArray[np.float32], rng: np.random.Generator, pattern: FixedPattern | None
    ) -> tuple[Singles, Singles, Singles, Singles, Singles]:
        """Return the arguments of the kernels: radiance, random numbers, parameters and pattern.

        The random numbers are standard normal, one per pixel.
        """
        normal = rng.standard_normal(radiance.shape, dtype=np.float32)
        empty = np.empty(0, dtype=np.float32)
        # as the arrays of a pattern are: Numba compiles the kernels once for both
        empty.setflags(write=False)
        pattern_values = (
            (empty, empty)
            if pattern is None
            else (pattern.sensitivity.ravel(), pattern.offset.ravel())
        )
        return radiance.ravel(), normal.ravel(), self._kernel_parameters, *pattern_values

    @property
    def _kernel_parameters(self) -> NDArray[np.float32]:
        """Parameters (6,) for the kernels; see ``noise_kernels.expose_pixels``."""
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
