"""Noise of a sticker's centre, tabulated over its ellipse.

It is the inverse of the mean, over where the centre lies within a pixel, of the covariance that the
fit states there, `centre_kernels.fit_covariances`. It grows with the rim: over the mean half axis m
it changes little with m, and smoothly with the ovalness p = (A_xx - A_yy) / 2 m and q = A_xy / m of
the ellipse's shape A.
"""

from functools import lru_cache

import numpy as np

from cmmsim.detection.ellipse_fit import SMALLEST_RADIUS_PX, fit_settings
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.without_images.centre_kernels import CentreNoise, fit_covariances

OVAL = np.linspace(-0.78, 0.78, 14)  # of p and of q
RADII = 8  # mean half axes, up to half of what is fitted
MOST_OVAL = 0.85
SHARP_PHASES = 5
BLURRED_PHASES = 2  # places within a pixel, along each axis
EDGE_PX = 0.2  # that a tabulated ellipse stays within the part that is fitted
LIGHTS = np.array([0.4, 0.7, 1.0])  # shares of light at which its effect is followed


@lru_cache(maxsize=16)
def centre_noise(
    noise: CameraNoise, psf_px: float, fit_size: int, sticker: float, ring: float
) -> CentreNoise:
    """The table for stickers and rings of these radiances, 0 to 1, fitted in parts of ``fit_size``
    px.
    """
    dark, bright, black = (
        float(noise.mean_grey(np.array(level))) for level in (ring, sticker, 0.0)
    )
    settings = fit_settings(noise, psf_px)
    phases = SHARP_PHASES if psf_px == 0.0 else BLURRED_PHASES
    within = (np.arange(phases) + 0.5) / phases - 0.5

    def covariances(shapes: Array, light: float) -> Array:
        """Mean covariances (n,2,2) of centres of ellipses with shapes (n,2,2)."""
        found = np.empty((len(shapes), 5, 5))
        total = np.zeros((len(shapes), 2, 2))
        for phase in np.stack(np.meshgrid(within, within), axis=-1).reshape(-1, 2):
            centres = np.tile(0.5 * (fit_size - 1) + phase, (len(shapes), 1))
            contrasts = np.full(len(shapes), light * (bright - dark))
            grounds = np.full(len(shapes), black + light * (dark - black))
            still = np.zeros((len(shapes), 2))
            fit_covariances(centres, shapes, still, contrasts, grounds, fit_size, settings, found)
            total += found[:, :2, :2]
        return total / phases**2

    radii = np.linspace(SMALLEST_RADIUS_PX, 0.5 * fit_size, RADII)
    m, p, q = np.meshgrid(radii, OVAL, OVAL, indexing="ij")
    found = covariances(_shapes(m.ravel(), p.ravel(), q.ravel(), 0.5 * fit_size - EDGE_PX), 1.0)
    known = np.linalg.inv(found)[:, [0, 0, 1], [0, 1, 1]] / m.reshape(-1, 1)
    table = known.reshape(*m.shape, 3)
    usual = _shapes(np.array([0.3 * fit_size]), np.array([0.25]), np.array([0.0]), 0.5 * fit_size)
    growth = [float(np.trace(covariances(usual, light)[0])) for light in LIGHTS]
    by_light = (
        np.polynomial.Polynomial.fit(LIGHTS, LIGHTS**2 * np.array(growth) / growth[-1], 2)
        .convert()
        .coef
    )
    first = np.array([radii[0], OVAL[0], OVAL[0]])
    steps = np.array([np.diff(radii)[0], *2 * [np.diff(OVAL)[0]]])
    return CentreNoise(
        table, first, steps, by_light, bright - dark, dark - black, black, fit_size, settings
    )


def _shapes(m: Array, p: Array, q: Array, largest: float) -> Array:
    """Shapes (n,2,2) of mean half axes m (n,) px and ovalness p, q (n,), with half axes that can be
    fitted.
    """
    oval = np.minimum(np.hypot(p, q), MOST_OVAL)
    angle = 0.5 * np.arctan2(q, p)
    long, short = (
        np.clip(m * (1.0 + sign * oval), SMALLEST_RADIUS_PX, largest) for sign in (1.0, -1.0)
    )
    mean = 0.5 * (long + short)
    half = 0.5 * (long - short)
    xx = mean + half * np.cos(2 * angle)
    xy = half * np.sin(2 * angle)
    yy = mean - half * np.cos(2 * angle)
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
