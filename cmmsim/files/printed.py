"""Sizes of the print errors that a sensor file states, and random errors of each sticker."""

from __future__ import annotations

import numpy as np

from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array
from cmmsim.geometry.sticker_print import PrintSizes


def print_sizes(file: SensorFile) -> PrintSizes:
    """Return the sizes of the stickers' print errors in a sensor file."""
    stickers = file.stickers
    section = file.print
    rim = stickers.sticker_level if section.rim_level is None else section.rim_level
    return PrintSizes(
        section.thickness / stickers.radius,
        (rim - stickers.ring_level) / (stickers.sticker_level - stickers.ring_level),
        section.unevenness,
        section.outline / stickers.radius,
        section.retro_shift / stickers.radius,
    )


def drawn_print(file: SensorFile, count: int, stream: int) -> tuple[Array, Array]:
    """Draw the coefficients of brightness (n, 5) and outline (n, 8) of a body's n stickers.

    ``stream`` is 0 for the platform and 1 for the base.
    """
    rng = np.random.default_rng([file.print.seed, stream])
    return print_sizes(file).drawn(count, rng)
