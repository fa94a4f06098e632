"""What differs from pixel to pixel of one camera, the same in every image (EMVA 1288: PRNU and DSNU)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FixedPattern:
    """sensitivity of each pixel relative to the mean, and its offset in the dark in e-; arrays of one shape."""

    sensitivity: NDArray[np.float32]
    offset: NDArray[np.float32]

    def windows(self, corners: NDArray[np.int_], size: int) -> FixedPattern:
        """The pattern (k, size, size) in windows with first pixels ``corners`` (k, 2) as (x, y).

        Outside of the image it repeats the image's edge.
        """
        height, width = self.sensitivity.shape
        ticks = np.arange(size)
        rows = np.clip(corners[:, 1, None] + ticks, 0, height - 1)[:, :, None]
        columns = np.clip(corners[:, 0, None] + ticks, 0, width - 1)[:, None, :]
        return FixedPattern(self.sensitivity[rows, columns], self.offset[rows, columns])


def draw_pattern(shape: tuple[int, int], prnu: float, dsnu: float, rng: np.random.Generator) -> FixedPattern:
    """Pattern of a camera with ``shape`` (height, width): white, normal, of relative std ``prnu`` and ``dsnu`` e-."""
    sensitivity = 1.0 + np.float32(prnu) * rng.standard_normal(shape, dtype=np.float32)
    offset = np.float32(dsnu) * rng.standard_normal(shape, dtype=np.float32)
    for values in (sensitivity, offset):
        values.setflags(write=False)
    return FixedPattern(sensitivity, offset)
