"""Charts: coordinates of a platform, one for each of its freedoms, and the pose that they mean.

A pose has the six entries [x y z alpha beta gamma] (eq. 1) for every robot. The coordinates of a
platform with fewer freedoms are the entries that it can change. The others stay as they are at
home.
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
    """Chart of a name, for a robot whose pose at home is `home` (six numbers)."""

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
        """Derivative d(pose)/d(coordinates) (6, n), which also spans the twists.

        Rotations are about the axes of the base in every chart.
        """
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
        """Coordinates (n,) or (N, n) of poses (6,) or (N, 6).

        The entries that the platform cannot change are ignored.
        """
        values = np.asarray(pose, dtype=float)
        return (
            values.copy()
            if len(self.freedoms) == len(POSE_NAMES)
            else values[..., list(self.freedoms)]
        )

    def projected(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., n, k) of the coordinates from rows (..., 6, k) of the twist: basis.T @ rows.

        The same array if n is 6.
        """
        return rows if len(self.freedoms) == len(POSE_NAMES) else rows[..., list(self.freedoms), :]

    def lifted(self, values: np.ndarray, axis: int = -1) -> np.ndarray:
        """Values of poses from values of coordinates, along an axis of length m.

        Values are rates or derivatives. The same array if m is 6.
        """
        if len(self.freedoms) == len(POSE_NAMES):
            return values
        rows = np.moveaxis(values, axis, -1)
        lifted = np.zeros((*rows.shape[:-1], len(POSE_NAMES)))
        lifted[..., list(self.freedoms)] = rows
        return np.moveaxis(lifted, -1, axis)

    def forbidden(self, pose: ArrayLike) -> np.ndarray:
        """Part of poses (N, 6) that the platform cannot have, in each entry, m and rad."""
        values = np.asarray(pose, dtype=float)
        if len(self.freedoms) == len(POSE_NAMES):
            return np.zeros(values.shape)
        return values - self.pose(self.coordinates(values))
