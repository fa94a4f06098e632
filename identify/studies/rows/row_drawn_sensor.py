"""A sensor without images: the true pose with noise of a covariance, drawn. Fast, and with known statistics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

import cmmsim
from cmmsim.pose_estimation.measurement import lost_measurement
from identify.arrays import Array


class DrawnSensor:
    """Measures as a `cmmsim.Sensor` does, with Gaussian noise of one covariance (6, 6) [m, rad] and with dropout."""

    sees_bodies = False

    def __init__(self, covariance: Array, dropout: float = 0.0) -> None:
        self._covariance, self._dropout = covariance, dropout
        self._factor = np.linalg.cholesky(covariance)
        self.start_run(0)

    def start_run(self, seed: int) -> None:
        """Begin a new run with noise of its own."""
        self._rng = np.random.default_rng(seed)

    def measure(
        self, pose: ArrayLike, obstacles: Mapping[str, Array] | None = None, pose_rate: ArrayLike | None = None
    ) -> cmmsim.Measurement:
        """The pose (6,) with noise; what stands in the way and how fast it moves make no difference."""
        noise, dropped = self._factor @ self._rng.standard_normal(6), self._rng.random() < self._dropout
        if dropped:
            return lost_measurement("dropped frame")
        none = np.zeros((0, 2))
        return cmmsim.Measurement(
            np.asarray(pose, dtype=float) + noise,
            self._covariance,
            np.zeros((0, 3)),
            np.zeros((0, 3, 3)),
            none,
            none,
            np.array([], dtype=str),
            True,
        )
