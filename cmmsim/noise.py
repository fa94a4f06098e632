"""Camera noise after the linear model of EMVA 1288.

Radiance (0 to 1) becomes electrons, shot noise and dark noise are added, the gain K turns electrons into grey values,
which are clipped and rounded. Shot noise is drawn as a normal variable of the Poisson variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import CmmError
from .pose import Array


@dataclass(frozen=True)
class CameraNoise:
    """EMVA 1288 figures of one camera.

    electrons_at_white   electrons at radiance 1 after one exposure, e-
    gain                 system gain K, grey values per e-
    dark_noise           temporal noise in the dark, e- rms
    full_well            saturation capacity, e-
    black_level          grey value at no light
    enabled              False: no noise; the mean grey value is still rounded to 8 bit
    """

    electrons_at_white: float
    gain: float
    dark_noise: float
    full_well: float
    black_level: float
    enabled: bool = True

    def __post_init__(self) -> None:
        if min(self.electrons_at_white, self.gain, self.full_well) <= 0.0 or self.dark_noise < 0.0:
            raise CmmError(f"camera noise needs positive electrons, gain and full well, got {self}")

    def mean_grey(self, radiance: NDArray[np.floating]) -> NDArray[np.floating]:
        """Expected grey values of radiance 0 to 1."""
        electrons = np.minimum(radiance * self.electrons_at_white, self.full_well)
        return self.black_level + self.gain * electrons

    def variance(self, mean_grey: Array) -> Array:
        """Variance of a grey value with this mean: shot noise, dark noise and rounding (grey values squared)."""
        electrons = np.maximum((mean_grey - self.black_level) / self.gain, 0.0)
        return self.gain**2 * (electrons + self.dark_noise**2) + 1.0 / 12.0

    def expose(self, radiance: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
        """One 8-bit exposure of a radiance image (float32, 0 to 1)."""
        return np.rint(np.clip(self._analog(radiance, rng), 0.0, 255.0)).astype(np.uint8)

    def mean_of_exposures(self, radiance: NDArray[np.float32], rng: np.random.Generator, frames: int) -> Array:
        """Mean grey values of ``frames`` independent 8-bit exposures of a scene that stands still (float64)."""
        total = np.zeros(radiance.shape, dtype=np.int64)
        for _ in range(frames):
            total += self.expose(radiance, rng)
        return total / frames

    def _analog(self, radiance: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.floating]:
        if not self.enabled:
            return self.mean_grey(radiance)
        electrons = np.minimum(radiance * np.float32(self.electrons_at_white), np.float32(self.full_well))
        noise = rng.standard_normal(radiance.shape, dtype=np.float32)
        noise *= np.sqrt(electrons + np.float32(self.dark_noise**2))
        return np.float32(self.black_level) + np.float32(self.gain) * (electrons + noise)
