"""Any number of stickers on a plane with the same middle and the same spread, so that their number alone differs.

Points evenly spaced in angle on an ellipse have the same mean and the same second moments whatever their number is,
from three on: n stickers know a plane or a pose sqrt(n) times better than one would.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cmmsim.geometry.pose import Array


def ring_of_stickers(listed: Sequence[tuple[float, float]], count: int) -> Array:
    """Places (count, 2) [u, v], m, on the ellipse one standard deviation around the middle of those listed (n, 2)."""
    places = np.asarray(listed, dtype=float)
    reach = np.linalg.cholesky(np.cov(places.T, bias=True))
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.asarray(places.mean(axis=0) + np.column_stack([np.cos(angle), np.sin(angle)]) @ reach.T, dtype=float)


def closest(places: Array) -> float:
    """Smallest distance between two neighbours of a ring (n, 2), m."""
    return float(np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1).min())
