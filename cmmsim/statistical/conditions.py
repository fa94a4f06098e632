"""The conditions for which exposures without images were proved to be like those with images; others are refused."""

import numpy as np

from cmmsim.detection.ellipse_fit import RING_REACH
from cmmsim.errors import CmmError
from cmmsim.files.schema import SensorFile
from cmmsim.plugins import DEFAULT_DETECTOR
from cmmsim.radiometry.noise import NO_SWING, CameraNoise
from cmmsim.statistical.exposure import NAME, Light

WIDEST_PSF_PX = 1.0
CLIPPED = 3.0  # standard deviations of noise that must stay between black and white


def require_proved(file: SensorFile, noise: CameraNoise, light: Light) -> None:
    """Raise CmmError, naming the key and its limit, where a sensor is none for which it was proved."""
    ring, bright = (float(noise.mean_grey(np.array(level))) for level in (light.ring, light.sticker))
    low, high = (float(np.sqrt(noise.variance(np.array(grey)))) for grey in (ring, bright))
    stickers = file.stickers
    wrong = [
        (file.detection.detector != DEFAULT_DETECTOR, f"detection.detector {file.detection.detector!r}", DEFAULT_DETECTOR),
        (not noise.enabled, "camera.noise false", "true: without noise, rounding alone decides"),
        (noise.prnu > 0.0 or noise.dsnu > 0.0, f"camera.prnu {noise.prnu:g}, dsnu {noise.dsnu:g}",
         "0: a pattern is the same in each frame"),
        (low**2 < NO_SWING, f"noise of {low:.2g} grey values in the dark", f"at least {NO_SWING**0.5:.2g}"),
        (ring < CLIPPED * low or bright > noise.white_level - CLIPPED * high,
         f"rings and stickers of {ring:.0f} and {bright:.0f} grey values",
         f"{CLIPPED:g} standard deviations of noise within 0 to {noise.white_level}"),
        (file.lens.psf_px > WIDEST_PSF_PX, f"lens.psf_px {file.lens.psf_px:g}", f"at most {WIDEST_PSF_PX:g}"),
        (stickers.ring_radius < RING_REACH * stickers.radius, f"stickers.ring_radius {stickers.ring_radius:g} m",
         f"at least {RING_REACH:g} times radius {stickers.radius:g} m"),
    ]  # fmt: skip
    for refused, what, needed in wrong:
        if refused:
            raise CmmError(
                f"renderer {NAME!r} is not proved for {what}, only for {needed}; take the renderer analytic or pyrender"
            )
