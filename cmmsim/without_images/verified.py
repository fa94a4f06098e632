"""Conditions under which exposures without images were verified against images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.ellipse_fit import RING_REACH
from cmmsim.errors import CmmError
from cmmsim.files.schema import SensorFile
from cmmsim.radiometry.noise import NO_SWING, CameraNoise

if TYPE_CHECKING:
    from cmmsim.without_images.drawn_stickers import Light

NAME = "statistical"
# Largest verified standard deviation of the point spread, and largest length of motion blur.
WIDEST_PSF_PX = 0.8
LONGEST_STREAK_PX = 4.0
# Grey values must be at least this many standard deviations of noise away from black and white.
CLIPPED = 3.0


def require_proved(file: SensorFile, noise: CameraNoise, light: Light) -> None:
    """Raise CmmError, with the key and its limit, for a sensor outside the verified conditions.

    If several conditions are not met, only the first one is named.
    """
    ring, bright = (
        float(noise.mean_grey(np.array(level))) for level in (light.ring, light.sticker)
    )
    low, high = (float(np.sqrt(noise.variance(np.array(grey)))) for grey in (ring, bright))
    stickers = file.stickers
    detector = file.detection.detector
    zero_keys = {
        "light.lamps": len(file.light.lamps),
        "light.fall_off": file.light.fall_off,
        "light.clutter": file.light.clutter,
        "lens.aperture": file.lens.aperture,
        "lens.ghost": file.lens.ghost,
        "timing.row_time": file.timing.row_time,
    }
    wrong = [
        (detector != DEFAULT_DETECTOR, f"detection.detector {detector!r}", DEFAULT_DETECTOR),
        (stickers.dark, "dark stickers", "bright ones in dark rings"),
        (not noise.enabled, "camera.noise false", "true: without noise, rounding alone decides"),
        (noise.prnu > 0.0 or noise.dsnu > 0.0, f"camera.prnu {noise.prnu:g}, dsnu {noise.dsnu:g}",
         "0: a fixed pattern is the same in each frame"),
        (low**2 < NO_SWING, f"noise of {low:.2g} grey values in the dark",
         f"at least {NO_SWING**0.5:.2g}, here camera.dark_noise of {_least_dark(noise, low):.3g} "
         f"electrons in place of {noise.dark_noise:.3g}"),
        (ring < CLIPPED * low or bright > noise.white_level - CLIPPED * high,
         f"rings and stickers of {ring:.0f} and {bright:.0f} grey values",
         f"{CLIPPED:g} standard deviations of noise within 0 to {noise.white_level}"),
        (file.lens.psf_px > WIDEST_PSF_PX, f"lens.psf_px {file.lens.psf_px:g}", "at most "
                                                                                f"{WIDEST_PSF_PX:g}"),
        (stickers.ring_radius < RING_REACH * stickers.radius, "stickers.ring_radius "
                                                              f"{stickers.ring_radius:g} m",
         f"at least {RING_REACH:g} times radius {stickers.radius:g} m"),
        (not (file.print.is_perfect or file.print.known), "print.known false", "true"),
        *((value != 0, f"{key} {value:g}", "0") for key, value in zero_keys.items()),
    ]  # fmt: skip
    for refused, condition, needed in wrong:
        if refused:
            raise CmmError(_not_proved(condition, needed))


def _least_dark(noise: CameraNoise, low: float) -> float:
    """Return the least verified dark noise, electrons, rounded up to three digits.

    ``low`` is the noise on rings, grey values. Shot noise and rounding are parts of it.
    """
    least = np.sqrt(max(NO_SWING - low**2, 0.0) / noise.gain**2 + noise.dark_noise**2)
    digit = 10.0 ** (np.floor(np.log10(least)) - 2)
    return float(np.ceil(least / digit) * digit)


def require_short(longest_px: float) -> None:
    """Raise CmmError if the motion blur of a sticker exceeds the verified length."""
    if longest_px > LONGEST_STREAK_PX:
        raise CmmError(
            _not_proved(
                f"stickers that move by {longest_px:.1f} px during the exposure",
                f"at most {LONGEST_STREAK_PX:g} px",
            )
        )


def _not_proved(condition: str, needed: str) -> str:
    return (
        f"renderer {NAME!r} is not verified for {condition}, only for {needed}; use the renderer "
        "analytic or pyrender"
    )
