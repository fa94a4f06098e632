"""The conditions for which exposures without images were proved to be like those with images;
others are refused.
"""

from dataclasses import dataclass

import numpy as np

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.ellipse_fit import RING_REACH
from cmmsim.errors import CmmError
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.camera import Optics
from cmmsim.radiometry.noise import NO_SWING, CameraNoise

NAME = "statistical"
WIDEST_PSF_PX = 1.0
LONGEST_STREAK_PX = 4.0
CLIPPED = 3.0  # standard deviations of noise that must stay between black and white


@dataclass(frozen=True)
class Light:
    """Radiance, 0 to 1, of stickers and of their rings, and what the lens leaves of it."""

    sticker: float
    ring: float
    optics: Optics


def require_proved(file: SensorFile, noise: CameraNoise, light: Light) -> None:
    """Raise CmmError, naming the key and its limit, where a sensor is none for which it was
    proved."""
    ring, bright = (
        float(noise.mean_grey(np.array(level))) for level in (light.ring, light.sticker)
    )
    low, high = (float(np.sqrt(noise.variance(np.array(grey)))) for grey in (ring, bright))
    stickers = file.stickers
    detector = file.detection.detector
    wrong = [
        (detector != DEFAULT_DETECTOR, f"detection.detector {detector!r}", DEFAULT_DETECTOR),
        (not noise.enabled, "camera.noise false", "true: without noise, rounding alone decides"),
        (noise.prnu > 0.0 or noise.dsnu > 0.0, f"camera.prnu {noise.prnu:g}, dsnu {noise.dsnu:g}",
         "0: a pattern is the same in each frame"),
        (low**2 < NO_SWING, f"noise of {low:.2g} grey values in the dark", "at least "
                                                                           f"{NO_SWING**0.5:.2g}"),
        (ring < CLIPPED * low or bright > noise.white_level - CLIPPED * high,
         f"rings and stickers of {ring:.0f} and {bright:.0f} grey values",
         f"{CLIPPED:g} standard deviations of noise within 0 to {noise.white_level}"),
        (file.lens.psf_px > WIDEST_PSF_PX, f"lens.psf_px {file.lens.psf_px:g}", "at most "
                                                                                f"{WIDEST_PSF_PX:g}"),
        (stickers.ring_radius < RING_REACH * stickers.radius, "stickers.ring_radius "
                                                              f"{stickers.ring_radius:g} m",
         f"at least {RING_REACH:g} times radius {stickers.radius:g} m"),
    ]  # fmt: skip
    for refused, what, needed in wrong:
        if refused:
            raise CmmError(_not_proved(what, needed))


def require_short(longest_px: float) -> None:
    """Raise CmmError where an exposure draws stickers out farther than it was proved for."""
    if longest_px > LONGEST_STREAK_PX:
        raise CmmError(
            _not_proved(
                f"stickers drawn out over {longest_px:.1f} px by the exposure",
                f"at most {LONGEST_STREAK_PX:g} px",
            )
        )


def _not_proved(what: str, needed: str) -> str:
    return (
        f"renderer {NAME!r} is not proved for {what}, only for {needed}; take the renderer "
        "analytic or pyrender"
    )
