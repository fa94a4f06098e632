"""Charts: the coordinates of a platform, as many as it has freedoms, and the pose that they mean.

A pose has six entries [x y z alpha beta gamma] (eq. 1) for every robot; the coordinates of a platform with fewer
freedoms are those of them that it can change, and the others stay what they are at home.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

POSE_NAMES = ("x", "y", "z", "alpha", "beta", "gamma")
POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")

FREEDOMS = {"free": (0, 1, 2, 3, 4, 5), "translation": (0, 1, 2), "planar": (0, 1, 5)}
"""Entries of the pose that a platform can change, by the names of the charts."""


@dataclass(frozen=True)
class Chart:
    """A chart by its name, for a robot that is at `home` (a pose as six numbers)."""

    name: str
    home: tuple[float, ...]

    @property
    def freedoms(self) -> tuple[int, ...]:
        """Entries of the pose that are the coordinates."""
        return FREEDOMS[self.name]

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return tuple(POSE_NAMES[entry] for entry in self.freedoms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the coordinates, m or rad."""
        return tuple(POSE_UNITS[entry] for entry in self.freedoms)

    @property
    def basis(self) -> np.ndarray:
        """d(pose)/d(coordinates) (6, n), which also spans the twists: rotations are about base axes in every chart."""
        return np.eye(6)[:, list(self.freedoms)]

    def pose(self, coordinates: ArrayLike) -> np.ndarray:
        """Poses (6,) or (N, 6) of coordinates (n,) or (N, n)."""
        values = np.asarray(coordinates, dtype=float)
        poses = np.empty((*values.shape[:-1], len(POSE_NAMES)))
        if len(self.freedoms) == len(POSE_NAMES):
            poses[...] = values
            return poses
        poses[...] = self.home
        poses[..., list(self.freedoms)] = values
        return poses

    def coordinates(self, pose: ArrayLike) -> np.ndarray:
        """Coordinates (n,) or (N, n) of poses (6,) or (N, 6); what the platform cannot change is not asked for."""
        values = np.asarray(pose, dtype=float)
        return values.copy() if len(self.freedoms) == len(POSE_NAMES) else values[..., list(self.freedoms)]

    def projected(self, rows: np.ndarray) -> np.ndarray:
        """What rows (..., 6, k), one for each entry of the twist, say of the coordinates (..., n, k), basis.T @ rows:
        the same if n is 6."""
        return rows if len(self.freedoms) == len(POSE_NAMES) else rows[..., list(self.freedoms), :]

    def lifted(self, values: np.ndarray, axis: int = -1) -> np.ndarray:
        """Rates or derivatives of coordinates, along an axis of length m, as those of poses; the same if m is 6."""
        if len(self.freedoms) == len(POSE_NAMES):
            return values
        rows = np.moveaxis(values, axis, -1)
        lifted = np.zeros((*rows.shape[:-1], len(POSE_NAMES)))
        lifted[..., list(self.freedoms)] = rows
        return np.moveaxis(lifted, -1, axis)

    def forbidden(self, pose: ArrayLike) -> np.ndarray:
        """How far poses (N, 6) are from those that the platform can take, in each entry, m and rad."""
        values = np.asarray(pose, dtype=float)
        if len(self.freedoms) == len(POSE_NAMES):
            return np.zeros(values.shape)
        return values - self.pose(self.coordinates(values))
