"""Errors of sticker centres due to imperfect print, drawn without images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array
from cmmsim.measuring.print_allowance import centre_errors_px

PRINT_STREAM = 2


@dataclass(frozen=True)
class CentreErrors:
    """Errors of sticker centres due to uneven print and outlines that are not round.

    ``constant`` (2, m, 2) px are the constant errors of each sticker in both images, and
    ``changing_px`` is the rms of the errors that change from exposure to exposure.
    """

    constant: Array
    changing_px: float

    @classmethod
    def of(cls, file: SensorFile, radius_px: float, count: int) -> CentreErrors:
        """Draw the errors of ``count`` stickers with the radius ``radius_px`` in the image."""
        constant, changing = centre_errors_px(file, radius_px)
        rng = np.random.default_rng([file.print.seed, PRINT_STREAM])
        return cls(constant * rng.standard_normal((2, count, 2)), changing)

    def added_to(self, centres: Array, rng: np.random.Generator) -> Array:
        """Return the centres (2, m, 2) of one exposure, with their errors."""
        return centres + self.constant + self.changing_px * rng.standard_normal(centres.shape)
