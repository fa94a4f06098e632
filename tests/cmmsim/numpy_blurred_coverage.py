"""Share of light in each pixel of a blurred ellipse, for all windows at once in plain numpy: the oracle of the compiled
one, whose derivation holds here too (``cmmsim.blurred_coverage``)."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from cmmsim.geometry.pose import Array

POINTS_PER_SIGMA = 1.25  # rim points to one standard deviation of the point spread
FEWEST_POINTS = 24


def blurred_coverage(centres: Array, shapes: Array, size: int, psf_px: float) -> tuple[Array, Array]:
    """As the product's ``blurred_coverage``."""
    count = rim_points(float(np.linalg.norm(shapes, axis=2).max(initial=0.0)), psf_px)
    angle = 2.0 * np.pi * np.arange(count) / count
    u = np.stack([np.cos(angle), np.sin(angle)])
    rim = centres[:, :, None] + shapes @ u
    normal = np.linalg.det(shapes)[:, None, None] * np.linalg.solve(shapes, np.broadcast_to(u, rim.shape))
    normal *= 2.0 * np.pi / count
    ticks = (np.arange(size + 1) - 0.5)[:, None]
    below = [(ticks - rim[:, None, k]) / psf_px for k in range(2)]
    across = [np.diff(ndtr(b), axis=1) for b in below]  # g, (n, size, count)
    density = np.exp(-0.5 * below[0] ** 2) / np.sqrt(2.0 * np.pi)
    passed = 1.0 - psf_px * np.diff(below[0] * ndtr(below[0]) + density, axis=1)  # P
    share = across[1] @ (passed * normal[:, :1]).transpose(0, 2, 1)
    rates = (
        normal[:, 0],
        normal[:, 1],
        u[0] * normal[:, 0],
        u[1] * normal[:, 0] + u[0] * normal[:, 1],
        u[1] * normal[:, 1],
    )
    derivatives = [across[1] @ (across[0] * rate[:, None]).transpose(0, 2, 1) for rate in rates]
    return share, np.stack(derivatives, axis=-1)


def rim_points(largest_radius: float, psf_px: float) -> int:
    """Points on the rim of an ellipse whose largest radius is known, px."""
    return max(FEWEST_POINTS, int(np.ceil(2.0 * np.pi * largest_radius * POINTS_PER_SIGMA / psf_px)))
