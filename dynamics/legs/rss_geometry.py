"""Geometry of a 6-RSS robot: six cranks (R) on the base, six links between two spherical joints (S) each."""

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from dynamics.errors import RobotFileError

LEGS = 6


@dataclass(frozen=True, eq=False)
class Rss6Geometry:
    """Where the joints sit and how the legs reach. All lengths in m, all vectors in base axes unless named otherwise.

    base_joints: B, crank axis foot points (6, 3); platform_joints: a in platform axes (6, 3);
    crank_axes: s, unit (6, 3); crank_zero_directions: unit vector from B to the tip T at angle zero (6, 3);
    crank_length, link_length: scalars; home_pose (6,); travel_limit: largest |theta| in rad; gravity (3,) in m/s^2.
    Raises RobotFileError when a vector is not a unit vector, a crank direction is not normal to its axis,
    or a length is not positive. Two geometries are equal when all their numbers are.
    """

    base_joints: np.ndarray
    platform_joints: np.ndarray
    crank_axes: np.ndarray
    crank_zero_directions: np.ndarray
    crank_length: float
    link_length: float
    home_pose: np.ndarray
    travel_limit: float
    gravity: np.ndarray

    def __post_init__(self) -> None:
        for name in ("base_joints", "platform_joints", "crank_axes", "crank_zero_directions", "home_pose", "gravity"):
            array = np.array(getattr(self, name), dtype=float)
            shape = {"home_pose": (6,), "gravity": (3,)}.get(name, (LEGS, 3))
            if array.shape != shape or not np.isfinite(array).all():
                raise RobotFileError(f"{name} must be finite with shape {shape}, got shape {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name in ("crank_length", "link_length", "travel_limit"):
            if not 0 < getattr(self, name) < np.inf:
                raise RobotFileError(f"{name} must be positive and finite, got {getattr(self, name)}")
        self._check_directions()

    @cached_property
    def digest(self) -> bytes:
        """Fingerprint of all numbers; the key of what is built from a geometry."""
        content = hashlib.sha256()
        for field in fields(self):
            content.update(np.asarray(getattr(self, field.name), dtype=float).tobytes())
        return content.digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rss6Geometry) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def characteristic_length(self) -> float:
        """Length in m that makes rotations comparable to translations: RMS distance of the joints A from the origin."""
        return float(np.sqrt(np.mean(np.sum(self.platform_joints**2, axis=1))))

    def crank_frames(self, angle: np.ndarray) -> np.ndarray:
        """Base-from-crank rotations (6, 3, 3) at crank angles (6,), rad: x from B to T, z along the joint axis."""
        axis, zero = self.crank_axes, self.crank_zero_directions
        x = np.cos(angle)[:, None] * zero + np.sin(angle)[:, None] * np.cross(axis, zero)
        return np.stack([x, np.cross(axis, x), axis], axis=-1)

    def crank_tips(self, angle: np.ndarray) -> np.ndarray:
        """Crank tips T (6, 3), m, at crank angles (6,), rad."""
        return np.asarray(self.base_joints + self.crank_length * self.crank_frames(angle)[:, :, 0])

    def _check_directions(self) -> None:
        for leg in range(LEGS):
            axis, zero = self.crank_axes[leg], self.crank_zero_directions[leg]
            for name, vector in (("crank_axes", axis), ("crank_zero_directions", zero)):
                if abs(np.linalg.norm(vector) - 1.0) > 1e-9:
                    raise RobotFileError(f"{name} of leg {leg + 1} has length {np.linalg.norm(vector):.9g}, must be 1")
            if abs(axis @ zero) > 1e-9:
                raise RobotFileError(
                    f"crank_zero_directions of leg {leg + 1} must be normal to its crank axis; "
                    f"their dot product is {axis @ zero:.3g}, limit 1e-9"
                )
